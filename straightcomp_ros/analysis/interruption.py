"""What disturbed a recorded run: stalls of the host, an interruption of its motion, or a clock that jumps."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import MOVING, SHORTEST_STROKE, Stroke, runs_of, speed_at_end, strokes_and_jumps
from straightcomp_ros.bags.reader import StreamColumns
from straightcomp_ros.timing.node_timing import Report

Stamps = NDArray[np.int64]
_LATE = 1.0
"""Sampling periods beyond the median from which a sample or command is late: a command that is due one period after its
sample comes too late then, and the board holds the platform by itself."""

PAUSE = 1.0
"""Gap in s between two samples from which the recording was paused, if the stage stood: during such a stall of the host
the driver or the board would have switched off."""


def played(stamps: Stamps) -> Stamps:
    """Time (n,) in ns from the first of these stamps (n,) to each, in which a pause of the recording, or a jump of its
    clock, is no longer than :data:`PAUSE`, and a jump back takes none."""
    return np.append(0, np.cumsum(np.diff(stamps).clip(0, round(PAUSE * 1e9))))


class Stall(NamedTuple):
    """A time in which the host failed the loop: first and last moment in s, on the clock of the record."""

    start: float
    end: float


def stalls_of(
    samples: Stamps, commands: Stamps, state: Stamps, driver: Mapping[str, NDArray[np.float64]]
) -> list[Stall]:
    """The stalls, in order and apart from each other, in s from the stamp 0.

    Args:
        samples: (n,) stamps in ns, rising, of the samples that are there.
        commands: (m,) those that have a command.
        state: (k,) stamps of the driver's record of samples; (0,) if it was not recorded.
        driver: its columns by name, (k,) each, see :data:`straightcomp_ros.contract.DRIVER_STATE`; none are needed.
    """
    none = np.full(state.size, np.nan)
    latency, lateness, enabled = (driver.get(name, none) for name in ("command_latency", "lateness", "enabled"))
    steps = np.diff(samples)
    period = float(np.median(steps))
    gaps = np.flatnonzero((steps > 1.5 * period) & (steps < PAUSE * 1e9))
    inside = samples[(samples >= commands[0]) & (samples <= commands[-1])]
    without = inside[~np.isin(inside, commands)]
    late, later = (_late(times, period * 1e-9) for times in (latency, lateness))
    silent = np.isnan(latency) & (enabled == 1.0)
    # More than half: its controller answers several samples at once.
    first, stop = runs_of(silent if 2 * np.count_nonzero(silent) < silent.size else silent[:0]).T
    first, last = first[stop - first > 1], stop[stop - first > 1] - 1
    begins_and_ends = (
        (samples[gaps], samples[gaps + 1]),
        (without, without + period),
        (state[late] - latency[late] * 1e9 - period, state[late]),
        (state[first] - period, state[last]),
        (state[later], state[later] + lateness[later] * 1e9),
    )
    found = [(float(one) * 1e-9, float(end) * 1e-9) for ones in begins_and_ends for one, end in zip(*ones, strict=True)]
    stalls: list[Stall] = []
    for start, end in sorted(found):
        if stalls and start <= stalls[-1].end:
            stalls[-1] = Stall(stalls[-1].start, max(end, stalls[-1].end))
        else:
            stalls.append(Stall(start, end))
    return stalls


def _late(times: NDArray[np.float64], period: float) -> NDArray[np.bool_]:
    known = times[np.isfinite(times)]
    usual = float(np.median(known)) if known.size else 0.0
    # A comparison with NaN is false.
    return np.asarray(times > usual + _LATE * period)


ENDS_APART = 0.02
"""Time in s by which the streams of a recording may end apart: a batch of samples takes up to 4 ms, and the logger
fetches 50 times a second."""
_NOTICED = 0.02
"""Least jump in s of a clock that is looked for: the usual delays of a recording hide what is less."""
_AROUND = 5.0
"""Time in s before and after a jump in which the least delay of the recording is taken: its stalls are shorter."""
_PACE = (0.8, 1.25)
"""Pace of the recording's clock relative to the samples' within which both count the same time; a bag that was played
or computed at another pace has no clock to compare with."""
_STEADY = 20
"""Samples to each side of a jump from which the stage's speed is taken."""


class LatchedFault(NamedTuple):
    """A fault that a node reported: when, in ns since the epoch, its label and the reason."""

    time_ns: int
    label: str
    reason: str


class EncoderRun(NamedTuple):
    """All samples of a run, whether the law answered them or not."""

    stamps: Stamps  # (n,) ns, rising
    off: NDArray[np.bool_]  # (n,) where the amplifier was off; all False where it never was on
    judged_ns: int  # stamp of the last sample that has reference and command and, in a simulation, the truth
    strokes: Sequence[Stroke]
    jumps: NDArray[np.intp]  # (m,) samples at which x is not where the stage can have gone
    lost_at: float  # speed in m/s at the last sample, if the recording was cut off there or went on without samples
    left_on: bool  # whether the samples end so with the amplifier on
    pauses: Stamps  # (p,) ns, of the last sample before each pause of the recording
    ended: str  # which streams end at `judged_ns`, if the motion goes on
    on_at: float  # speed in m/s at the first sample, if the amplifier was switched on there

    @property
    def end_ns(self) -> int:
        """Stamp up to which the law had to answer: of the last sample in motion, if the recording goes on after the
        last answer; else that of the last answer."""
        if not self.strokes or self.stamps[-1] - self.judged_ns <= ENDS_APART * 1e9:
            return self.judged_ns
        return max(self.judged_ns, int(self.stamps[self.strokes[-1].stop - 1]))

    def unanswered(self, answers: Stamps) -> int:
        """Samples without an answer up to the last that had to have one, or has one of the ``answers`` (m,), stamps."""
        inside = self.stamps[self.stamps <= max(int(answers[-1]), self.end_ns)]
        return int(np.count_nonzero(~np.isin(inside, answers)))

    def moving(self, begin_ns: int, until_ns: int) -> NDArray[np.bool_]:
        """The samples (n,) in motion from ``begin_ns`` to before ``until_ns``."""
        moving = np.zeros(self.stamps.size, np.bool_)
        for stroke in self.strokes:
            moving[stroke.samples] = True
        return np.asarray(moving & (self.stamps >= begin_ns) & (self.stamps < until_ns))

    def interruption(self, faults: Sequence[LatchedFault], begin_ns: int, until_ns: int, zero_ns: int) -> str:
        """Why the law did not run for the whole motion from ``begin_ns`` to before ``until_ns``, with times since
        ``zero_ns``; empty if it did."""

        def at(stamp_ns: int) -> str:
            return f"{(stamp_ns - zero_ns) * 1e-9:.3f} s"

        within = (self.stamps >= begin_ns) & (self.stamps < until_ns)
        steps = np.diff(self.stamps)
        holes = np.flatnonzero(within[:-1] & (steps >= PAUSE * 1e9) & ~np.isin(self.stamps[:-1], self.pauses))
        moving = self.moving(begin_ns, until_ns)
        latched = {fault.label: fault for fault in reversed(faults) if begin_ns <= fault.time_ns < until_ns}
        found = [f"fault {one.label} at {at(one.time_ns)} ({one.reason})" for one in sorted(latched.values())]
        found += [f"x jumps at {at(int(self.stamps[jump]))}" for jump in self.jumps[within[self.jumps]][:1]]
        found += [f"no sample came for {steps[one] * 1e-9:.3f} s after {at(int(self.stamps[one]))}" for one in holes]
        if off := np.count_nonzero(moving & self.off):
            found.append(f"the amplifier was off for {off} samples of the motion")
        if self.on_at >= MOVING and self.strokes and within[self.strokes[0].start]:
            found.append(f"the amplifier was switched on with the stage moving at {self.on_at * 1e3:.3g} mm/s")
        if begin_ns <= self.end_ns < until_ns and self.end_ns > self.judged_ns:
            left = f"{np.count_nonzero(moving & (self.stamps > self.judged_ns))} more of the motion have none"
            found.append(f"after {at(self.judged_ns)} no sample has {self.ended}, {left}")
        moves = self.lost_at >= MOVING
        if within[-1] and (moves or self.left_on):
            speed = f" and the stage moving at {self.lost_at * 1e3:.3g} mm/s" if moves else ""
            state = "on" if self.left_on or not self.off[-1] else "off"
            found.append(f"the samples end with the amplifier {state}{speed}")
        return "; ".join(found)


def encoder_run(
    stamps: Stamps,
    x: NDArray[np.float64],
    on: NDArray[np.bool_],
    judged_ns: int,
    *,
    goes_on: bool = False,
    silent: bool = False,
    ended: str = "reference and command",
    on_at: float = 0.0,
) -> EncoderRun:
    """The run with these samples (n,): stamps in ns, rising, x in m, and whether the amplifier was on. Whether the
    machine ``goes_on`` after the last of them, or is ``silent``: the recording is cut off, or goes on without samples
    for longer than a host stalls. ``ended`` names the streams that end at ``judged_ns``; ``on_at`` as of the result."""
    gaps = np.flatnonzero(np.diff(stamps) >= PAUSE * 1e9)
    stands = np.abs(x[gaps + 1] - x[gaps]) < SHORTEST_STROKE
    # An encoder that fails reads NaN.
    known = np.flatnonzero(np.isfinite(x))
    time, x = (stamps[known] - stamps[0]) * 1e-9, x[known]
    strokes, jumps = strokes_and_jumps(time, x) if known.size > 2 else ((), known[:0])
    placed = [Stroke(int(known[one.start]), int(known[one.stop - 1]) + 1, one.direction) for one in strokes]
    for one in placed:
        stands &= (gaps + 1 < one.start) | (gaps >= one.stop)
    lost_at = speed_at_end(time, x) if goes_on or silent else 0.0
    left_on = silent and bool(on[-1])
    pauses = stamps[gaps[stands]]
    return EncoderRun(stamps, ~on & on.any(), judged_ns, placed, known[jumps], lost_at, left_on, pauses, ended, on_at)


def latched_faults(reports: Mapping[str, Sequence[Report]], begin_ns: int) -> tuple[LatchedFault, ...]:
    """What the nodes reported as an error from ``begin_ns`` on, in the order of time."""
    return tuple(
        sorted(
            LatchedFault(report.time_ns, *map(str.strip, error.partition(":")[::2]))
            for own in reports.values()
            for report in own
            if report.time_ns >= begin_ns and (error := report.values.get("error", ""))
        )
    )


def clock_jump(samples: StreamColumns) -> str:
    """Where the clock behind the stamps of the encoder's ``samples`` jumps, in words; empty if it runs on.

    Where the stamps are not one period apart, the time between two samples is also known by the clock of the recording,
    and by how far the stage went at its speed. A pause of the recording agrees with both.
    """
    stamps, recorded, x = samples.stamp, samples.log_time, samples.columns["x"]
    steps = np.diff(stamps)
    rising = steps[steps > 0]
    if not rising.size:
        return ""
    period = int(np.median(rising))
    least = max(_NOTICED * 1e9, 1.5 * period)
    places = np.flatnonzero(np.abs(steps - period) > least)
    if not places.size and rising.size == steps.size:
        return ""
    delay = recorded - stamps
    late_by = np.abs(delay - int(np.median(delay)))
    parts = [slice(*edge) for edge in itertools.pairwise([0, *(places + 1).tolist(), len(stamps)])]
    # Single messages that came late stand among later ones.
    late = [one for one in parts[1:-1] if one.stop - one.start < _STEADY and late_by[one].max() < PAUSE * 1e9]
    for before, after in itertools.pairwise([part for part in parts if part not in late]):
        by_recording = _by_recording(stamps, recorded, before, after, period)
        for jump in (by_recording, _by_motion(stamps, x, before, after, period)):
            if abs(jump) > least:
                by = _duration(jump * 1e-9)
                return f"the stamps jump by {by} after sample {before.stop - 1}, though the machine ran on"
    order = np.argsort(stamps, kind="stable")
    same = np.diff(stamps[order]) == 0
    # By their bytes: NaN is the same reading as NaN.
    readings = np.stack([x, samples.columns["y"]])[:, order].view(np.int64)
    repeated = np.count_nonzero(same & (np.diff(readings, axis=1) != 0).any(axis=0))
    why = "the clock was set back, or two nodes publish samples"
    return f"{repeated} stamps came twice, with other readings: {why}" if repeated else ""


def _sides(before: slice, after: slice, most: int) -> tuple[slice, slice]:
    """Up to ``most`` samples to each side of a jump, the last ``before`` it and the first ``after`` it."""
    last, first = max(before.start, before.stop - most), min(after.stop, after.start + most)
    return slice(last, before.stop), slice(after.start, first)


def _by_recording(stamps: Stamps, recorded: Stamps, before: slice, after: slice, period: int) -> float:
    """Jump in ns by the clock of the recording; 0 where that clock says nothing."""
    for part in (before, after):
        span = int(stamps[part.stop - 1] - stamps[part.start])
        pace = (recorded[part.stop - 1] - recorded[part.start]) / span if span > _NOTICED * 1e10 else 1.0
        if not _PACE[0] <= pace <= _PACE[1]:
            return 0.0
    sides = _sides(before, after, max(1, round(_AROUND * 1e9 / period)))
    least_before, least_after = (int((recorded[side] - stamps[side]).min()) for side in sides)
    return float(least_before - least_after)


def _by_motion(stamps: Stamps, x: NDArray[np.float64], before: slice, after: slice, period: int) -> float:
    """Jump in ns by the way of the stage from the last sample before to the first after; 0 where it stands."""
    sides = [x[side] for side in _sides(before, after, _STEADY)]
    if min(map(len, sides)) < _STEADY:
        return 0.0
    # Of each side in m a sample: the stage accelerates little within some samples.
    speeds = [float(side[-1] - side[0]) / (len(side) - 1) for side in sides]
    if min(map(abs, speeds)) < MOVING * period * 1e-9 or speeds[0] * speeds[1] < 0.0:
        return 0.0
    way = float(x[after.start] - x[before.stop - 1])
    elapsed = way / (0.5 * sum(speeds)) * period
    stamped = float(stamps[after.start] - stamps[before.stop - 1])
    # The stage may have stopped or turned in a pause: then its way says nothing of the time.
    return stamped - elapsed if 0.0 <= elapsed <= 5.0 * period else 0.0


def _duration(seconds: float) -> str:
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("s", 1.0)):
        if abs(seconds) >= size:
            return f"{seconds / size:.6g} {unit}"
    return f"{seconds * 1e3:.4g} ms"
