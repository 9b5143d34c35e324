"""Starts nodes at once: all modules are loaded before, and each node is a fork of this process.

    python -m straightcomp_ros.trials.faults.nursery

A line on standard input is a JSON object, and so is the line that answers it on standard output:
``{"start": [module, arguments …], "log": file}`` gives ``{"pid": …}``, ``{"wait": pid}`` gives ``{"code": …}``, null
while it runs. The end of standard input ends all that was started. A node that gets :data:`TELL_STACKS` writes into its
log where its threads are.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import importlib
import json
import os
import signal
import sys
from typing import Any

from straightcomp_ros.trials.faults import forking

TELL_STACKS = signal.SIGUSR1
_MODULES = ("driver_node", "faulty_driver", "feedforward_node", "controller_node", "logger_node")
_PR_SET_PDEATHSIG = 1


def _start(words: list[str], log: str) -> int:
    pid = os.fork()
    if pid:
        return pid
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    faulthandler.register(TELL_STACKS)
    sys.argv = words
    # Through the interpreter's own end: only there does the middleware remove its files from shared memory.
    sys.exit(importlib.import_module(f"straightcomp_ros.nodes.{words[0]}").main())


def _ended(pid: int) -> int | None:
    found, status = os.waitpid(pid, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def main() -> int:
    """Serve until the end of standard input."""
    forking.without_blas_threads()
    for module in _MODULES:
        importlib.import_module(f"straightcomp_ros.nodes.{module}")
    forking.tell_tracing()
    started: list[int] = []
    for line in sys.stdin:
        request: dict[str, Any] = json.loads(line)
        if "start" in request:
            started.append(_start(request["start"], request["log"]))
            answer: dict[str, Any] = {"pid": started[-1]}
        else:
            answer = {"code": _ended(request["wait"])}
            if answer["code"] is not None:
                started.remove(request["wait"])
        print(json.dumps(answer), flush=True)
    for pid in started:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return 0


if __name__ == "__main__":
    sys.exit(main())
