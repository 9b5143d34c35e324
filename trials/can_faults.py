"""Sends a known machine's frames through faults to the receiver, and compares the received samples with the truth."""

import dataclasses
import random
from collections.abc import Mapping
from typing import NamedTuple

from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Report
from straightcomp_ros.hardware.can.hub import FLOOD, Faults, Frame, addressed
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.stage.description import StageParameters

_COUNT, _CURRENT = 1e-7, 0.01
"""m of a count of the positions here, and A."""
_ROUNDED = 2e-7
"""m; what a float of 32 bits leaves of a position of 2 m. From sample to sample y changes by more."""
_DRIFT = 100e-6
"""Of the board's clock."""
_LEAD_IN = 4 * BLOCK
_TRANSIT_NS = 110_000
_START_NS = 1_700_000_000_000_000_000


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
        counts, sequence, sets = self.receiver.counts, self.receiver.sequence, self.receiver.sets
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
    """Counts of x and y at the sample ``index``: the stage at 0.3 m/s, the platform at 1.4 mm/s."""
    return _to_and_fro(1500 * index, 17_600_000), _to_and_fro(7 * index, 440) - 220


def _to_and_fro(way: int, length: int) -> int:
    way %= 2 * length
    return min(way, 2 * length - way)


def run_trial(
    rates: Mapping[str, float],
    board: CanParameters,
    *,
    frames: int = 20_000,
    seed: int = 1,
) -> Trial:
    """Send ``frames`` samples, and inject faults after the clock has settled.

    Args:
        rates: see :class:`~straightcomp_ros.hardware.can.hub.Faults`.
        board: its DBC file and kind of bus.
        frames: samples to send.
        seed: of jitter and faults.
    """
    # The error counter would end a real run; here every single fault must be seen.
    receiver = Receiver(dataclasses.replace(board, strike_limit=1000, sample_memory=100_000), StageParameters())
    wire = receiver.wire
    faults, chance = Faults(rates, seed), random.Random(seed)
    period_ns = 500_000 * (1.0 + _DRIFT)
    for k in range(frames):
        arrival_ns = _START_NS + round(k * period_ns) + _TRANSIT_NS + round(chance.expovariate(1 / 40e3))
        for frame in _frames(wire, k, arrival_ns):
            # Count only the faults of one frame of each sample, not those of the slow ones.
            hurt = k > _LEAD_IN and frame.identifier == wire.sample.identifier and k < frames - 2
            for arrived in faults(frame) if hurt else [frame]:
                receiver.take(arrived, arrived.stamp_ns)
    wrong = 0
    for index, sample, _ in receiver.samples:
        x, y = position(index)
        good = abs(sample.x - x * _COUNT) < _ROUNDED and abs(sample.y - y * _COUNT) < _ROUNDED
        late_ns = sample.stamp_ns - _START_NS - round(index * period_ns) - _TRANSIT_NS
        wrong += not (good and 0 <= index < frames and abs(late_ns) < 100_000)
    return Trial(frames, faults.injected, len(receiver.samples), wrong, receiver)


def _frames(wire: Wire, index: int, stamp_ns: int) -> list[Frame]:
    x, y = (counts * _COUNT for counts in position(index))
    counter = index % wire.number_modulus
    report = Report(0, counter, x, y, _CURRENT, Amplifier.ON, wire.fault_codes[BoardFault.NONE], True, True)
    sent = []
    for frames in wire.reports.values():
        if index % frames.every == 0:
            alive = index // frames.every % frames.alive_modulus
            payload = frames.pack(report._replace(alive=alive), index)
            sent.append(addressed(frames.identifier, payload, fd=frames.fd, stamp_ns=stamp_ns))
    return sent
