"""Measure the cost of packing and unpacking CAN frames, and count how many injected bus faults are detected.

Frames of known samples go through injected faults on both kinds of bus: each kind of fault alone, to the receiver, then
all together with the closed loop. With `--set driver.can.firmware=PROGRAM` the board is the firmware core. Exit code 1
if a fault was not detected, or a wrong sample used."""

import argparse
import random
import timeit
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.cli.options import add_parameter_options, check_range, chosen_parameters
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Command, Report
from straightcomp_ros.hardware.can.hub import FLOOD, KINDS, Faults, Frame, addressed
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.stage.description import StageParameters
from trials.can_servo import ServoTrial
from trials.rig import tracked

SUMMARY = "µs per CAN frame, bus faults injected and found"
_REPEATS, _CALLS = 25, 1000
_RATE = 0.02
_TOGETHER, _CUT = 0.002, 0.0002
"""Rates of all kinds together, for a closed loop that stays on most of the time."""
COUNTED = tuple(kind for kind in KINDS if kind != "cut")
"""Kinds that damage one frame. A cut affects the link, and is tested on a real one."""
_REPORT = Report(4, 4, 1.2345678, -67.8e-6, -0.09, Amplifier.ON, 0, True, True)
_COMMAND = Command(3, True, False, -0.05, 4)
_COUNT, _CURRENT = 1e-7, 0.01
"""m of a count of the positions here, and A."""
_ROUNDED = 2e-7
"""m; what a float of 32 bits leaves of a position of 2 m. From sample to sample y changes by more."""
_DRIFT = 100e-6
"""Of the board's clock."""
_LEAD_IN = 4 * BLOCK
_TRANSIT_NS = 110_000
_START_NS = 1_700_000_000_000_000_000


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
    boards = {"classic": replace(can, fd=False), "fd": replace(can, fd=True)}
    if can.dbc:
        boards = {Path(can.dbc).stem: can}
    costs, loops, wrong = dict[str, dict[str, float]](), dict[str, dict[str, Any]](), 0
    counts = {kind: {"injected": 0, "detected": 0} for kind in COUNTED}
    for bus, board in boards.items():
        costs |= codec_costs(board.make_wire())
        for kind in tracked(COUNTED, bus):
            trial = run_trial({kind: _RATE}, board, **how)
            counts[kind]["injected"] += trial.injected[kind]
            counts[kind]["detected"] += trial.detected(kind)
            wrong += trial.unflagged_wrong
        loop = ServoTrial({kind: _CUT if kind == "cut" else _TOGETHER for kind in KINDS}, guide, board, **how)
        wrong += loop.unflagged_wrong
        figures = {"state": loop.state.value, "on": loop.on, "latched": loop.latched, "unsafe": loop.unsafe}
        loops[bus] = {"frames": options.frames, "injected": sum(loop.injected.values()), **figures}
    shown = {"codec": costs, "frames": options.frames, "faults": counts, "closed_loop": loops}
    print_json({"dbc": can.make_wire().dbc.file, "fd": can.fd, **shown, "unflagged_wrong": wrong})
    missed = any(count["injected"] != count["detected"] for count in counts.values())
    return int(missed or wrong > 0 or any(loop["unsafe"] for loop in loops.values()))


def codec_costs(wire: Wire) -> dict[str, dict[str, float]]:
    """Least time in µs to pack (``pack_us``) and to unpack (``unpack_us``) each frame, by its name in the DBC file."""

    def least_us(work: Any, *arguments: Any) -> float:
        return min(timeit.repeat(lambda: work(*arguments), number=_CALLS, repeat=_REPEATS)) / _CALLS * 1e6

    frames = [(one, _REPORT) for one in wire.reports.values()] + [(one, _COMMAND) for one in wire.commands]
    return {
        one.name: {"pack_us": least_us(one.pack, values), "unpack_us": least_us(one.unpack, one.pack(values))}
        for one, values in frames
    }


class Trial(NamedTuple):
    """Faults of the encoder's frames, and what the receiver made of the frames.

    ``unflagged_wrong`` counts samples accepted with a number, position or time of no sample that was taken.
    """

    frames: int
    injected: Mapping[str, int]
    delivered: int
    unflagged_wrong: int
    receiver: Receiver

    def detected(self, kind: str) -> int:
        """Number of faults of a kind that the receiver counted, in a trial with this kind alone."""
        counts, sequence, sets = Counter(self.receiver.counts), self.receiver.sequence, self.receiver.sets
        checks = sum(counts[check] for check in ("length", "crc", "alive", "state", "implausible"))
        return {
            "drop": sequence.lost,
            "duplicate": sequence.repeated + sets.repeated,
            "reorder": sequence.out_of_order + sets.out_of_order,
            "wrong_id": counts["foreign"] + checks,
            "error_frame": counts["error_frames"],
            "remote": counts["remote"],
            "flood": counts["foreign"] // FLOOD,
        }.get(kind, checks)


def position(index: int) -> tuple[int, int]:
    """Counts of x and y at the sample ``index``, to and fro: the stage at 0.3 m/s, the platform at 1.4 mm/s."""
    x, y = 17_600_000, 440
    return x - abs(1500 * index % (2 * x) - x), y // 2 - abs(7 * index % (2 * y) - y)


def run_trial(rates: Mapping[str, float], board: CanParameters, *, frames: int = 20_000, seed: int = 1) -> Trial:
    """Send ``frames`` samples of a board, at ``rates`` of :class:`~straightcomp_ros.hardware.can.hub.Faults`
    once the clock has settled; ``seed`` is that of jitter and faults."""
    # The error counter would end a real run; here every single fault must be seen.
    receiver = Receiver(replace(board, strike_limit=1000, sample_memory=100_000), StageParameters())
    faults, chance = Faults(rates, seed), random.Random(seed)
    period_ns = 500_000 * (1.0 + _DRIFT)
    for k in range(frames):
        arrival_ns = _START_NS + round(k * period_ns) + _TRANSIT_NS + round(chance.expovariate(1 / 40e3))
        for frame in _frames(receiver.wire, k, arrival_ns):
            # Count only the faults of one frame of each sample, not those of the slow ones.
            hurt = k > _LEAD_IN and frame.identifier == receiver.wire.sample.identifier and k < frames - 2
            for arrived in faults(frame) if hurt else [frame]:
                receiver.take(arrived, arrived.stamp_ns)
    wrong = 0
    for index, sample, _ in receiver.samples:
        x, y = position(index)
        good = abs(sample.x - x * _COUNT) < _ROUNDED and abs(sample.y - y * _COUNT) < _ROUNDED
        late_ns = sample.stamp_ns - _START_NS - round(index * period_ns) - _TRANSIT_NS
        wrong += not (good and 0 <= index < frames and abs(late_ns) < 100_000)
    return Trial(frames, faults.injected, len(receiver.samples), wrong, receiver)


def _frames(wire: Wire, index: int, stamp_ns: int) -> Iterator[Frame]:
    x, y = (counts * _COUNT for counts in position(index))
    counter, fault = index % wire.number_modulus, wire.fault_codes[BoardFault.NONE]
    for frames in wire.reports.values():
        if index % frames.every == 0:
            alive = index // frames.every % frames.alive_modulus
            report = Report(alive, counter, x, y, _CURRENT, Amplifier.ON, fault, True, True)
            yield addressed(frames.identifier, frames.pack(report, index), fd=frames.fd, stamp_ns=stamp_ns)
