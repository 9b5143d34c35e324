"""Measure the cost of packing and unpacking CAN frames, and count how many injected bus faults are detected.

Frames of known samples go through injected faults on both kinds of bus: each kind of fault alone, then all together
with the closed loop. With `--set driver.can.firmware=PROGRAM` the board is the firmware core. Exit code 1 if a fault
was not detected, or a wrong sample used."""

import argparse
import dataclasses
import statistics
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from straightcomp_ros.bench.step_costs import cost
from straightcomp_ros.cli.options import add_parameter_options, check_range, chosen_parameters
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames import Amplifier, Command, Report
from straightcomp_ros.hardware.can.hub import KINDS
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from trials.can_faults import run_trial
from trials.can_servo import run_servo_trial
from trials.rig import progress

SUMMARY = "µs per CAN frame, bus faults injected and found"
_REPEATS = 25
_RATE = 0.02
_TOGETHER, _CUT = 0.002, 0.0002
"""Rates of all kinds together, for a closed loop that stays on most of the time."""
COUNTED = tuple(kind for kind in KINDS if kind != "cut")
"""Kinds that damage one frame. A cut affects the link, and is tested on a real one."""
_CALLS = 1000
_REPORT = Report(4, 4, 1.2345678, -67.8e-6, -0.09, Amplifier.ON, 0, True)
_COMMAND = Command(3, True, False, -0.05, 4)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    add("--frames", type=int, default=20_000, help="samples sent for each kind of fault (default: %(default)s)")
    add("--seed", type=int, default=1, help="seed of the faults (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    check_range("--frames", options.frames, 1000, 10_000_000)
    driver = node_parameters("driver", chosen_parameters(options))
    wire, wires = driver.can.make_wire(), [board.make_wire() for board in buses(driver.can).values()]
    costs = codec_costs(wires, _REPEATS)
    with progress() as advance:
        counts, loops, wrong = fault_run(
            driver.guide(), driver.can, options.frames, options.seed, lambda done: advance("faults", done)
        )
    pack_us, unpack_us = (per_frame(costs, key, wire) for key in ("pack_us", "unpack_us"))
    figures = {"dbc": wire.dbc.file, "fd": driver.can.fd, "pack_us": pack_us, "unpack_us": unpack_us, "codec": costs}
    figures |= {"frames": options.frames, "faults": counts, "closed_loop": loops, "unflagged_wrong": wrong}
    print_json(figures)
    missed = any(count["injected"] != count["detected"] for count in counts.values())
    return int(missed or wrong > 0 or any(loop["unsafe"] for loop in loops.values()))


def buses(board: CanParameters) -> dict[str, CanParameters]:
    """Kinds of bus by name on which faults are injected: both of the package's own DBC file, or the one of another."""
    if board.dbc:
        return {Path(board.dbc).stem: board}
    return {name: dataclasses.replace(board, fd=fd) for name, fd in (("classic", False), ("fd", True))}


def fault_run(
    guide: StraightnessMap, board: CanParameters, frames: int, seed: int, progress: Callable[[float], object]
) -> tuple[dict[str, dict[str, int]], dict[str, dict[str, Any]], int]:
    """Test each kind of fault alone on the receiver, and all together on the closed loop, on each of :func:`buses`.

    Args:
        guide: of the simulated machine.
        board: its DBC file.
        frames: number for each kind and bus, and for each closed loop.
        seed: of the faults.
        progress: called with the finished fraction.

    Returns:
        By kind the counts ``injected`` and ``detected`` on all buses; by bus the result of the closed loop; the total
        of wrong samples that were used unflagged.
    """
    counts = {kind: {"injected": 0, "detected": 0} for kind in COUNTED}
    loops: dict[str, dict[str, Any]] = {}
    tried = buses(board)
    wrong, done, steps = 0, 0, (len(COUNTED) + 1) * len(tried)
    for bus, parameters in tried.items():
        for kind in COUNTED:
            trial = run_trial({kind: _RATE}, parameters, frames=frames, seed=seed)
            counts[kind]["injected"] += trial.injected[kind]
            counts[kind]["detected"] += trial.detected(kind)
            wrong += trial.unflagged_wrong
            done += 1
            progress(done / steps)
        rates = {kind: _CUT if kind == "cut" else _TOGETHER for kind in KINDS}
        loop = run_servo_trial(rates, guide, parameters, frames=frames, seed=seed)
        wrong += loop.unflagged_wrong
        loops[bus] = {
            "frames": loop.frames,
            "injected": sum(loop.injected.values()),
            "state": loop.state.value,
            "on": loop.on,
            "latched": dict(loop.latched),
            "unsafe": loop.unsafe,
        }
        done += 1
        progress(done / steps)
    return counts, loops, wrong


def codec_costs(wires: Iterable[Wire], repeats: int) -> dict[str, dict[str, float]]:
    """Median µs to pack (``pack_us``) and to unpack (``unpack_us``) each frame, by its name in the DBC file."""
    frames: dict[str, tuple[Callable[[Any], bytes], Callable[[bytes], object], Any]] = {}
    for wire in wires:
        for one in wire.reports.values():
            frames[one.name] = _first_page(one.pack), one.unpack, _REPORT
        for asked in wire.commands:
            frames[asked.name] = asked.pack, asked.unpack, _COMMAND
    return {
        name: {
            "pack_us": cost(_calls(pack, frame), _CALLS, repeats)["median_us"],
            "unpack_us": cost(_calls(unpack, pack(frame)), _CALLS, repeats)["median_us"],
        }
        for name, (pack, unpack, frame) in frames.items()
    }


def per_frame(costs: dict[str, dict[str, float]], key: str, wire: Wire) -> float:
    """Mean of ``key`` in :func:`codec_costs` over the frames of a control cycle: those of a sample and of a command."""
    return statistics.mean(costs[frames.name][key] for frames in (*wire.parts, *wire.commands))


def _first_page(pack: Callable[[Report, int], bytes]) -> Callable[[Report], bytes]:
    return lambda report: pack(report, 0)


def _calls(work: Callable[[Any], object], argument: Any) -> Callable[[], None]:
    def calls() -> None:
        for _ in range(_CALLS):
            work(argument)

    return calls
