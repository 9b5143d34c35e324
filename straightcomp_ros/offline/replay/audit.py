"""Computes every recorded command again from the recorded samples and references, and compares the bits.

The law's state depends on which samples it saw, in which order, and by which reference each was served. The recorded
`controller_state` tells all three: it has one message for each step of the law, with the age of its reference.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import StreamColumns, read_attachments, read_streams
from straightcomp_ros.bags.recorded_parameters import recorded_parameters
from straightcomp_ros.configuration.node_parameters import ControllerNodeParameters, node_parameters
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, ENCODER, REFERENCE
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.pairing import extrapolated
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.settings.declaration import ParameterError

_AUDITED = (ENCODER, REFERENCE, COMMAND, CONTROLLER_STATE)
_COLUMNS = ("control_current", *CONTROLLER_STATE.layout.columns[:-1])
"""What the law answers, in its order; the age of the reference is no answer."""
_GAP_NS = 20_000_000
"""Longest gap that the servo goes on after; beyond it the law starts anew."""


@dataclass(frozen=True)
class Difference:
    """A number that came out otherwise: of the step ``step`` of the recorded ones, ``stamp_ns`` of its sample."""

    step: int
    stamp_ns: int
    column: str
    recorded: float
    computed: float


@dataclass(frozen=True)
class Audit:
    """What came of it.

    Attributes:
        law: name of the law.
        commands: commands that were computed again and compared.
        different: those of them that came out otherwise, in the command or in the law's inner variables.
        unverified: recorded commands that cannot be computed: something that the law saw is not in the bag, and the
            law has not started anew since.
        missing: samples or references of those steps that are not in the bag.
        began_running: the recording began while the law was running already.
        first: the first difference, None without.
    """

    law: str
    commands: int
    different: int
    unverified: int
    missing: int
    began_running: bool
    first: Difference | None

    @property
    def passed(self) -> bool:
        """Something was compared, and nothing differed."""
        return self.commands > 0 and not self.different


def audit(bag: Path, remap: Mapping[str, str] | None = None) -> Audit:
    """Audit a bag.

    Args:
        bag: rosbag2 folder or MCAP file.
        remap: the bag's topic for each of ours that is named otherwise there.

    Raises:
        BagError: the bag is refused, or lacks a stream or the controller's parameters.
        ParameterError: a recorded parameter is refused.
    """
    streams = read_streams(bag, {stream.topic: stream.layout for stream in _AUDITED}, remap)
    for stream in _AUDITED:
        if stream.topic not in streams:
            raise BagError(f"bag {bag}: has no messages on '{stream.topic}'; an audit needs all four of the loop")
    values = recorded_parameters(bag, read_attachments(bag))
    if "controller" not in values:
        raise BagError(f"bag {bag}: the controller's parameters are not attached; name its node to the logger")
    try:
        parameters: ControllerNodeParameters = node_parameters("controller", values["controller"])
    except ParameterError as error:
        raise ParameterError(f"bag {bag}: {error}") from error
    if parameters.learning.learn:
        raise BagError(f"bag {bag}: the controller learned while it ran; what it knew before is not in the bag")
    return _audited(parameters, *(streams[stream.topic] for stream in _AUDITED))


def _audited(
    parameters: ControllerNodeParameters,
    encoder: StreamColumns,
    reference: StreamColumns,
    command: StreamColumns,
    state: StreamColumns,
) -> Audit:
    servo = Servo(make_law(parameters.control, 1.0 / parameters.rate))
    samples = _rows(encoder, "y", "coil_current")
    references = _rows(reference, *REFERENCE.layout.columns)
    currents = _rows(command, *COMMAND.layout.columns)
    recorded = zip(*(state.columns[name].tolist() for name in CONTROLLER_STATE.layout.columns), strict=True)
    # Commands go out one by one, states in bursts: where a state was lost, its command tells that there was a step.
    stateless = sorted(set(currents).difference(state.stamp.tolist()), reverse=True)
    steps = len(state) + len(stateless)

    compared = different = missing = 0
    followed, began_running = True, False
    last_ns: int | None = None
    first: Difference | None = None
    for step, (stamp_ns, numbers) in enumerate(zip(state.stamp.tolist(), recorded, strict=True)):
        while stateless and stateless[-1] < stamp_ns:
            followed = False
            missing += 1
            stateless.pop()
        sample = samples.get(stamp_ns)
        age_ns = round(numbers[-1] * 1e9) if math.isfinite(numbers[-1]) else -1
        given = references.get(stamp_ns - age_ns) if age_ns >= 0 else None
        if sample is None or given is None:
            followed = False
            missing += 1
            last_ns = stamp_ns
            continue
        y, coil_current = sample
        starts_anew = math.isnan(coil_current) or (last_ns is not None and abs(stamp_ns - last_ns) > _GAP_NS)
        last_ns = stamp_ns
        answer = servo.step(stamp_ns, y, coil_current, extrapolated(*given, age_ns * 1e-9))
        followed = followed or starts_anew
        current = currents.get(stamp_ns)
        if not followed or current is None:
            continue
        found = _first_difference(step, stamp_ns, (*current, *numbers[:-1]), answer)
        if found and not compared and not starts_anew:
            # The first step of the bag: the law may have run for long before.
            followed, began_running = False, True
            continue
        compared += 1
        if found:
            different += 1
            first = first or found
    unverified = steps - compared
    missing += len(stateless)
    return Audit(parameters.control.law, compared, different, unverified, missing, began_running, first)


def _rows(stream: StreamColumns, *columns: str) -> dict[int, tuple[float, ...]]:
    """Numbers by stamp; a repeated message is the same again."""
    return dict(
        zip(stream.stamp.tolist(), zip(*(stream.columns[name].tolist() for name in columns), strict=True), strict=True)
    )


def _first_difference(
    step: int, stamp_ns: int, recorded: tuple[float, ...], computed: tuple[float, ...] | None
) -> Difference | None:
    if computed is None:
        return Difference(step, stamp_ns, _COLUMNS[0], recorded[0], math.nan)
    if _PACK(*recorded) == _PACK(*computed):
        return None
    for name, one, other in zip(_COLUMNS, recorded, computed, strict=True):
        # NaN says «none» in whatever bit pattern.
        if struct.pack("<d", one) != struct.pack("<d", other) and not (math.isnan(one) and math.isnan(other)):
            return Difference(step, stamp_ns, name, one, other)
    return None


_PACK = struct.Struct(f"<{len(_COLUMNS)}d").pack
