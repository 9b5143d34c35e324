"""Measure the cost of packing and unpacking CAN frames, and count how many injected bus faults are detected.

Frames of known samples go through injected faults on both kinds of bus: each kind of fault alone, then all together
with the closed loop. With `--set driver.can.firmware=PROGRAM` the board is the firmware core. Exit code 1 if a fault
was not detected, or a wrong sample used."""

import argparse
import dataclasses
import timeit
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from straightcomp_ros.cli.options import add_parameter_options, check_range, chosen_parameters
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.frames import Amplifier, Command, Frames, Report
from straightcomp_ros.hardware.can.hub import KINDS
from straightcomp_ros.parameters.node_parameters import node_parameters
from trials.can_faults import run_trial
from trials.can_servo import ServoTrial
from trials.rig import progress

SUMMARY = "µs per CAN frame, bus faults injected and found"
_REPEATS, _CALLS = 25, 1000
_RATE = 0.02
_TOGETHER, _CUT = 0.002, 0.0002
"""Rates of all kinds together, for a closed loop that stays on most of the time."""
COUNTED = tuple(kind for kind in KINDS if kind != "cut")
"""Kinds that damage one frame. A cut affects the link, and is tested on a real one."""
_REPORT = Report(4, 4, 1.2345678, -67.8e-6, -0.09, Amplifier.ON, 0, True, True)
_COMMAND = Command(3, True, False, -0.05, 4)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    add("--frames", type=int, default=20_000, help="samples sent for each kind of fault (default: %(default)s)")
    add("--seed", type=int, default=1, help="seed of the faults (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    check_range("--frames", options.frames, 1000, 10_000_000)
    driver = node_parameters("driver", chosen_parameters(options))
    can, guide, how = driver.can, driver.guide(), {"frames": options.frames, "seed": options.seed}
    # Both kinds of bus of the package's own DBC file, or the one of another.
    boards = {"classic": dataclasses.replace(can, fd=False), "fd": dataclasses.replace(can, fd=True)}
    if can.dbc:
        boards = {Path(can.dbc).stem: can}
    costs: dict[str, dict[str, float]] = {}
    injected, detected, wrong = Counter[str](), Counter[str](), 0
    loops: dict[str, dict[str, Any]] = {}
    with progress() as advance:
        for place, (bus, board) in enumerate(boards.items()):
            costs |= codec_costs(board.make_wire())
            for number, kind in enumerate(COUNTED):
                advance(kind, (place + number / len(KINDS)) / len(boards))
                trial = run_trial({kind: _RATE}, board, **how)
                injected[kind] += trial.injected[kind]
                detected[kind] += trial.detected(kind)
                wrong += trial.unflagged_wrong
            advance("closed loop", (place + len(COUNTED) / len(KINDS)) / len(boards))
            loop = ServoTrial({kind: _CUT if kind == "cut" else _TOGETHER for kind in KINDS}, guide, board, **how)
            wrong += loop.unflagged_wrong
            loops[bus] = {
                "frames": options.frames,
                "injected": sum(loop.injected.values()),
                "state": loop.state.value,
                "on": loop.on,
                "latched": loop.latched,
                "unsafe": loop.unsafe,
            }
    faults = {kind: {"injected": injected[kind], "detected": detected[kind]} for kind in COUNTED}
    figures = {"codec": costs, "frames": options.frames, "faults": faults, "closed_loop": loops}
    print_json({"dbc": can.make_wire().dbc.file, "fd": can.fd, **figures, "unflagged_wrong": wrong})
    return int(injected != detected or wrong > 0 or any(loop["unsafe"] for loop in loops.values()))


def codec_costs(wire: Wire) -> dict[str, dict[str, float]]:
    """Least time in µs to pack (``pack_us``) and to unpack (``unpack_us``) each frame, by its name in the DBC file."""
    reports = {one.name: (one, _REPORT) for one in wire.reports.values()}
    return {name: _cost(*one) for name, one in (reports | {one.name: (one, _COMMAND) for one in wire.commands}).items()}


def _cost(frames: Frames, values: Report | Command) -> dict[str, float]:
    payload = frames.pack(values)
    return {"pack_us": _least_us(lambda: frames.pack(values)), "unpack_us": _least_us(lambda: frames.unpack(payload))}


def _least_us(work: Callable[[], object]) -> float:
    return min(timeit.repeat(work, number=_CALLS, repeat=_REPEATS)) / _CALLS * 1e6
