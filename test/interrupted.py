"""A verb that is killed, or whose disk is full, at each of its writes in turn.

The program runs the verb in forks of itself: to start Python for each would take minutes. What counts as a write is
each call that changes a file or a folder below the working folder: to open for writing, to write, to bring to the disk,
to rename, to remove, to make. A full disk stays full: from the call on all fail that need room, half of the bytes
written.
"""

import builtins
import errno
import io
import json
import os
import re
import shutil
import signal
import sys
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

FULL, KILL = "full", "kill"
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_ROOM = ("open", "write", "fsync", "os.mkdir", "os.link", "os.symlink", "os.rename")
_CHANGES = ("os.remove", "os.rmdir", "os.truncate", *_ROOM[3:])


class Fault:
    """Counts the writes below ``folder`` and spoils them from number ``at`` on; 0 for none."""

    def __init__(self, folder: Path, kind: str, at: int) -> None:
        self._folder, self._kind, self._at, self.count = f"{folder}{os.sep}", kind, at, 0
        self._fsync, self._open = os.fsync, io.open
        sys.addaudithook(self._audit)
        os.fsync = lambda file: self.see("fsync", file) or self._fsync(file)
        builtins.open = io.open = self._opened

    def see(self, what: str, path: object, before: object = lambda: None) -> None:
        """One write of ``path``, a name or a descriptor; ``before`` does the half of it that the fault lets pass."""
        with suppress(OSError, TypeError):
            path = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.path.abspath(os.fsdecode(path))
        if not str(path).startswith(self._folder):
            return
        self.count += 1
        if not self._at or self.count < self._at or (self._kind == FULL and what not in _ROOM):
            return
        before()
        if self._kind == KILL:
            os.kill(os.getpid(), signal.SIGKILL)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    def _audit(self, event: str, arguments: tuple) -> None:
        if event == "open" and not isinstance(arguments[0], int) and (arguments[2] or 0) & _WRITING:
            self.see("open", arguments[0])
        elif event in _CHANGES:
            self.see(event, arguments[0])

    def _opened(
        self, file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, closefd=True, opener=None
    ):
        if not set(mode) & set("wax+") or (not isinstance(file, int) and str(file).startswith("/proc/")):
            return self._open(file, mode, buffering, encoding, errors, newline, closefd, opener)
        raw = _Raw(file, re.sub("[bt]", "", mode), closefd, opener)
        raw.fault = self
        if buffering == 0:
            return raw
        buffered = (io.BufferedRandom if "+" in mode else io.BufferedWriter)(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding or "utf-8", errors, newline)


class _Raw(io.FileIO):
    fault: Fault

    def write(self, data):
        half = memoryview(data).cast("B")
        self.fault.see("write", self.fileno(), lambda: super(_Raw, self).write(half[: len(half) // 2]))
        return super().write(data)


def run(words: Sequence[str], folder: Path, kind: str, at: int) -> tuple[int, int, str]:
    """Run a verb in a fork with ``folder`` as its working folder; its exit code, its writes, what it said on stderr."""
    from straightcomp_ros.cli.main import main

    said, counted = folder.with_name("said"), folder.with_name("counted")
    child = os.fork()
    if child == 0:
        code = 99
        try:
            os.chdir(folder)
            for descriptor, name in ((1, os.devnull), (2, said)):
                os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), descriptor)
            fault = Fault(folder, kind, at)
            try:
                code = main(list(words))
            except SystemExit as ended:
                code = int(ended.code or 0)
            except BaseException:
                import traceback

                traceback.print_exc()
            counted.write_text(str(fault.count))
        finally:
            sys.stderr.flush()
            os._exit(code)
    status = os.waitpid(child, 0)[1]
    writes = int(counted.read_text()) if counted.exists() else 0
    counted.unlink(missing_ok=True)
    return os.waitstatus_to_exitcode(status), writes, said.read_text(errors="replace")


def content(folder: Path) -> dict[str, bytes]:
    """What a user sees in a folder: all files but those with a dot, and those of a run that has not finished."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    names = ((path, path.relative_to(folder)) for path in paths)
    return {str(name): path.read_bytes() for path, name in names if not re.search(r"(^|/)(\.|unfinished/)", str(name))}


def outcomes(words: Sequence[str], template: Path, work: Path, most: int) -> Iterator[dict]:
    """Faults at up to ``most`` writes of a verb, evenly spread, as facts of each: what was lost, and how it ended.

    Args:
        words: the verb, run in a copy of ``template``.
        template: inputs, and outputs of an earlier run.
        work: a folder for the copies.
        most: 0 for all writes.
    """
    before = content(template)

    def fresh() -> Path:
        folder = work / "here"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(template, folder, copy_function=shutil.copy2)
        return folder

    code, writes, said = run(words, fresh(), FULL, 0)
    after = {name: _steady(data) for name, data in content(work / "here").items()}
    yield {"at": 0, "kind": "none", "code": code, "writes": writes, "said": said}
    chosen = range(1, writes + 1)
    if 0 < most < writes:
        chosen = [chosen[number * (writes - 1) // (most - 1)] for number in range(most)]
    for kind in (FULL, KILL):
        for at in chosen:
            folder = fresh()
            code, _, said = run(words, folder, kind, at)
            now = content(folder)
            done = {name: _steady(data) for name, data in now.items()} == after
            # Under a name is what was there, or all of what was to come; nothing only where nothing is to come.
            spoiled = [
                name
                for name in {*before, *now}
                if now.get(name) != before.get(name)
                and not done
                and not (name in after and name in now and _steady(now[name]) == after[name])
                # A new bag without metadata.yaml is known to be unfinished, and what it has can be read.
                and not (name.endswith(".mcap") and name not in before and not metadata_of(name) & now.keys())
            ]
            left = [path.name for path in folder.rglob(".*.part")] if kind == FULL else []
            yield {"at": at, "kind": kind, "code": code, "spoiled": spoiled, "left": left, "done": done, "said": said}


def metadata_of(name: str) -> set[str]:
    return {str(Path(name).parent / "metadata.yaml")}


def _steady(data: bytes) -> bytes:
    """Content without its times and random numbers, of a text; whether a bag is whole; names of an archive."""
    if data.startswith(b"\x89MCAP"):
        return data[-8:]
    if data.startswith(b"PK"):
        with suppress(zipfile.BadZipFile), zipfile.ZipFile(io.BytesIO(data)) as archive:
            return repr((archive.namelist(), archive.testzip())).encode()
    return data if b"\0" in data else re.sub(rb"[0-9a-fA-F]+", b"", data)


if __name__ == "__main__":
    for fact in outcomes(sys.argv[4:], Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])):
        print(json.dumps(fact), flush=True)
