"""Does the first `make demo` work on a computer that is not prepared, and that has other work to do?

    sudo python3 scripts/first_runs.py --pythons python3.10 /usr/bin/python3 --users root somebody --runs 20

For each interpreter and user: a fresh clone of this checkout's last commit is set up once by `make setup`. Before each
run all caches are emptied (machine code, bytecode of the package, fonts, and, as root, the files that Linux keeps in
memory), and a busy process of nice 19 in a session of its own, as another program's is, takes each CPU. Then the user
runs `make demo`. A line is printed for each run; the exit code is 0 if all ended with 0 or were starved. `--quick` runs
`make quick` in each clone too, before the runs.

It needs root only for other users than who calls it, and to empty Linux's caches.
"""

from __future__ import annotations

import argparse
import json
import os
import pwd
import re
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_LONGEST_S = 300
_BUSY = "while True: pass"


def main() -> int:
    """Count the runs that ended with 0; returns the exit code."""
    options = _options()
    stands = [Stand(Path(options.folder), python, user) for python in options.pythons for user in options.users]
    failed = 0
    for stand in stands:
        stand.set_up()
        if options.quick:
            code, text = stand.run("make quick", _LONGEST_S)
            failed += code != 0
            print(f"{stand.name}: make quick: exit {code}: {_outcome(text)}", flush=True)
    # In turns: what disturbs the machine for a while disturbs all alike.
    for number in range(1, options.runs + 1):
        for stand in stands:
            print(f"{stand.name}: run {number}: {_first_run(stand, options.busy)}", flush=True)
    for stand in stands:
        print(f"{stand.name}: {stand.summary()}")
        failed += stand.failed
    return 1 if failed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", nargs="+", default=[sys.executable], metavar="PYTHON", help="interpreters")
    parser.add_argument("--users", nargs="+", default=[pwd.getpwuid(os.getuid()).pw_name], help="who runs the demo")
    parser.add_argument("--runs", type=int, default=20, help="of each (default: %(default)s)")
    parser.add_argument("--busy", type=int, default=1, help="busy processes on each CPU (default: %(default)s)")
    parser.add_argument("--folder", default="/var/tmp/first_runs", help="for the clones (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="run `make quick` in each clone too")
    return parser.parse_args()


def _first_run(stand: Stand, busy: int) -> str:
    """One run with empty caches and busy processes; returns what came of it."""
    stand.empty_caches()
    begin = time.monotonic()
    with load(busy):
        code, text = stand.run("make --silent demo ARGS=--json", _LONGEST_S)
    seconds = time.monotonic() - begin
    # A demonstration that busy processes starve prints its figures too; whether it ran is what counts here.
    if code and '"verdict": "starved"' not in text:
        stand.failed += 1
        shutil.copytree(stand.clone / "demo_output", stand.clone / f"failed_{stand.failed}", dirs_exist_ok=True)
        return f"exit {code}, {seconds:.0f} s: {' '.join(text.split())}"
    figures = json.loads(text[text.index("{") : text.rindex("}") + 1])
    stand.peak_to_peak.append(figures["true_pp_um"])
    return f"exit {code}, {seconds:.0f} s, {figures['true_pp_um']:.2f} µm. {figures['held_up']}"


class Stand:
    """A fresh clone with an environment of its own, that belongs to a user.

    Args:
        folder: for the clones.
        python: interpreter, as a name or a path.
        user: who it belongs to.
    """

    def __init__(self, folder: Path, python: str, user: str) -> None:
        self.name = f"{Path(python).name} {user}"
        self.clone = folder / self.name.replace(" ", "_")
        self._python, self._user = python, user
        self._home = Path(pwd.getpwnam(user).pw_dir)
        self.failed = 0
        self.peak_to_peak: list[float] = []
        """µm, of the runs that ended with 0."""

    def summary(self) -> str:
        """The counts, and the errors peak to peak."""
        good = len(self.peak_to_peak)
        words = f"{good} of {good + self.failed} ended with 0"
        if good:
            words += f"; p-p median {statistics.median(self.peak_to_peak):.2f}, largest {max(self.peak_to_peak):.2f} µm"
        return words

    def set_up(self) -> None:
        """Clone and `make setup`.

        Raises:
            SystemExit: it failed.
        """
        shutil.rmtree(self.clone, ignore_errors=True)
        self.clone.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(self.clone)], check=True)
        if os.getuid() == 0:
            subprocess.run(["chown", "-R", self._user, str(self.clone)], check=True)
        begin = time.monotonic()
        code, text = self.run(f"make setup PYTHON={self._python}", 1800)
        if code:
            raise SystemExit(f"{self.name}: make setup: exit {code}: {text}")
        print(f"{self.name}: set up in {time.monotonic() - begin:.0f} s", flush=True)

    def empty_caches(self) -> None:
        """Machine code, bytecode, fonts; and, where that is permitted, what Linux keeps of files in memory."""
        for cache in (self._home / ".cache" / "straightcomp_ros", self._home / ".cache" / "matplotlib"):
            shutil.rmtree(cache, ignore_errors=True)
        for bytecode in (self.clone / "straightcomp_ros").rglob("__pycache__"):
            shutil.rmtree(bytecode)
        if os.getuid() == 0:
            os.sync()
            Path("/proc/sys/vm/drop_caches").write_text("3")

    def run(self, command: str, longest_s: float) -> tuple[int, str]:
        """Run a command as the user; returns its exit code, and what it printed."""
        words = f"cd '{self.clone}' && timeout -s KILL {longest_s:.0f} {command}"
        # A login of its own: ROS 2's wheels leave the path of this interpreter's libraries in the environment.
        login = (
            ["su", "-", self._user, "-c"] if os.getuid() == 0 else ["env", "-i", f"HOME={self._home}", "bash", "-lc"]
        )
        done = subprocess.run([*login, words], stdin=subprocess.DEVNULL, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr


@contextmanager
def load(each: int) -> Iterator[None]:
    """So many busy processes on each CPU meanwhile, at nice 19."""
    processes = [
        subprocess.Popen(
            ["nice", "-n", "19", "taskset", "-c", str(cpu), sys.executable, "-c", _BUSY], start_new_session=True
        )
        for cpu in sorted(os.sched_getaffinity(0))
        for _ in range(each)
    ]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _outcome(text: str) -> str:
    """What pytest counted, and the tests that failed; all of the text, if it is not pytest's."""
    counted = [line for line in text.splitlines() if line.startswith("FAILED") or re.search(r"\d+ passed", line)]
    return "; ".join(counted) or text


if __name__ == "__main__":
    sys.exit(main())
