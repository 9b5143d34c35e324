"""Runs the tests without live nodes as other processors would, and prints a table.

    python scripts/processors.py [--only NAME ...] [PYTEST ARGUMENTS]

The last bits of a floating-point result differ between processors: OpenBLAS chooses its kernels, NumPy and Numba their
instructions. Here OpenBLAS is made to take another processor's kernels, NumPy gets none of the instructions that are
newer than what it was built for, and Numba none that not every x86-64 has. NumPy's names of instructions changed with
version 2.4 and it only warns of names that it does not know; so it is asked for them.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

REPOSITORY = Path(__file__).resolve().parents[1]
PROCESSORS = ("HASWELL", "SKYLAKEX", "ZEN", "PRESCOTT")
"""By OpenBLAS's names: AVX2 of Intel, AVX-512, AVX2 of AMD, nothing newer than SSE3."""
WITHOUT_TESTS = 5
"""pytest's exit code where nothing was chosen."""
_COUNT = re.compile(r"(\d+) (passed|failed|errors?|skipped|xfailed)")


def environment(processor: str) -> dict[str, str]:
    """This environment as that processor's."""
    umath = np._core._multiarray_umath if hasattr(np, "_core") else np.core._multiarray_umath
    # What is switched off already is not among those that it could use.
    newer = os.environ.get("NPY_DISABLE_CPU_FEATURES", "").split()
    newer += [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]
    return {
        **os.environ,
        "OPENBLAS_CORETYPE": processor,
        "NUMBA_CPU_NAME": "generic",
        "NPY_DISABLE_CPU_FEATURES": " ".join(newer),
        # Threads that wait for each other by spinning take the CPUs from the other tests.
        "OPENBLAS_NUM_THREADS": "1",
    }


def counts(printed: str) -> dict[str, int]:
    """How many tests ended how, by pytest's last line."""
    last = next((line for line in reversed(printed.splitlines()) if _COUNT.search(line)), "")
    return {name.rstrip("s") if name.startswith("error") else name: int(n) for n, name in _COUNT.findall(last)}


def main() -> int:
    """Run, print, and return 1 if a test failed anywhere."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PROCESSORS, default=PROCESSORS, metavar="NAME")
    options, arguments = parser.parse_known_args()
    if platform.machine() not in ("x86_64", "AMD64"):
        print(f"other processors are simulated on x86-64 only; this is {platform.machine()}", file=sys.stderr)
        return 2
    table = Table("OpenBLAS for", "passed", "failed", "errors", "skipped", "minutes", title="Tests without live nodes")
    failed = False
    for processor in options.only:
        print(f"\nAs on {processor}:", flush=True)
        begin = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", "-q", "-m", "not live", *arguments],
            cwd=REPOSITORY,
            env=environment(processor),
            stdout=subprocess.PIPE,
            text=True,
        )
        printed = []
        for line in process.stdout or ():
            print(line, end="", flush=True)
            printed.append(line)
        code = process.wait()
        found = counts("".join(printed))
        failed |= code not in (0, WITHOUT_TESTS)
        shown = [str(found.get(name, 0)) for name in ("passed", "failed", "error", "skipped")]
        table.add_row(processor, *shown, f"{(time.monotonic() - begin) / 60.0:.1f}")
    Console(width=100).print(table)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
