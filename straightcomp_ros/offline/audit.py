"""Computes every recorded command again from the recorded samples and references, and compares the bits.

The law's state depends on its samples, their order, and the reference of each. The recorded `controller_state` has
all three: it has one message for each step of the law, with the age of its reference.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import opened
from straightcomp_ros.bags.reader import StreamColumns, attachments_of, streams_of_stage
from straightcomp_ros.bags.recorded_nodes import noted_changes, parameters_of
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, ENCODER, REFERENCE
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.pairing import RUN_GAP_NS, extrapolated
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters, node_parameters

_AUDITED = (ENCODER, REFERENCE, COMMAND, CONTROLLER_STATE)
_COLUMNS = ("control_current", *CONTROLLER_STATE.layout.columns[:-1], "control_current")
"""Columns of the law's answer, in its order; at last its command again, for another one with the same stamp."""
_NOTICED_NS = 2_000_000_000
"""Time before a noted change from which it may have been made: its notice takes two threads their turns."""


@dataclass(frozen=True)
class Difference:
    """A number that differs: in the recorded step ``step``, for the sample of ``stamp_ns``."""

    step: int
    stamp_ns: int
    column: str
    recorded: float
    computed: float


@dataclass(frozen=True)
class Audit:
    """Result of an audit.

    Attributes:
        commands: commands that were computed again and compared.
        different: those of them that differ, in the command or in the law's inner variables.
        unverified: recorded commands that cannot be computed: an input of the law is not in the bag, and the law has
            not restarted since.
        missing: samples or references of those steps that are not in the bag, or are there twice with other numbers.
        changed: whether a parameter of the controller changed in the recording: what came then is not verified.
        began_running: whether the recording began while the law was running.
    """

    law: str
    commands: int
    different: int
    unverified: int
    missing: int
    changed: bool
    began_running: bool
    first: Difference | None

    @property
    def passed(self) -> bool:
        """Whether commands were compared and none differed."""
        return self.commands > 0 and not self.different


def audit(
    bag: Path,
    remap: Mapping[str, str] | None = None,
    given: Mapping[str, Mapping[str, Any]] | None = None,
) -> Audit:
    """Audit a bag.

    ``remap`` has the bag's topic for each of our topics that has another name there, ``given`` the parameters, by node
    and dotted name, of a bag that has none attached. Of several stages in the bag that of the encoder is taken.

    Raises:
        BagError: the bag is refused, or lacks a stream or the controller's parameters.
        ParameterError: a recorded parameter is refused.
    """
    with opened(bag) as files:
        streams = streams_of_stage(bag, files, _AUDITED, remap)
        for stream in _AUDITED:
            if stream.topic not in streams:
                raise BagError(f"bag {bag}: has no messages on '{stream.topic}'; an audit needs all four of the loop")
        values = parameters_of(bag, attachments_of(files), given, remap)
        changes = [
            when for when, changed in noted_changes(files) if any(name.startswith("controller.") for name in changed)
        ]
    valid_ns = min(changes, default=math.inf) - _NOTICED_NS
    try:
        parameters: ControllerNodeParameters = node_parameters("controller", values)
    except ParameterError as error:
        raise ParameterError(f"bag {bag}: {error}") from error
    if parameters.learning.learn:
        raise BagError(f"bag {bag}: the controller learned while it ran; what it knew before is not in the bag")
    servo = Servo(make_law(parameters.control, parameters.stage))
    state = streams[CONTROLLER_STATE.topic]
    # A file may have been written in another order; but the recorder's clock may have been set, too.
    received = state.taken(np.argsort(state.log_time, kind="stable"))
    state = received if (np.diff(received.stamp) >= 0).all() else state
    samples, disputed = _rows(streams[ENCODER.topic], "y", "coil_current")
    references, unclear = _rows(streams[REFERENCE.topic], *REFERENCE.layout.columns)
    currents, others = _rows(streams[COMMAND.topic], *COMMAND.layout.columns)
    recorded = zip(*(state.columns[name].tolist() for name in CONTROLLER_STATE.layout.columns), strict=True)
    # Commands are published one by one, states in batches: a command without a state means that the state was lost.
    stateless = sorted(set(currents).difference(state.stamp.tolist()), reverse=True)
    steps, missing = len(state) + len(stateless), len(stateless)
    compared = different = 0
    followed, began_running = True, False
    unsure = True  # whether the law may have been running, unrecorded, where it seems to start
    last_ns: int | None = None
    first: Difference | None = None
    steps_of = zip(state.stamp.tolist(), state.log_time.tolist(), recorded, strict=True)
    for step, (stamp_ns, logged_ns, numbers) in enumerate(steps_of):
        while stateless and stateless[-1] < stamp_ns:
            followed = False
            stateless.pop()
        # Of two samples or references with one stamp, nothing says which one the law took.
        sample = samples.get(stamp_ns) if stamp_ns not in disputed else None
        age_ns = round(numbers[-1] * 1e9) if math.isfinite(numbers[-1]) else -1
        source_ns = stamp_ns - age_ns
        reference = references.get(source_ns) if age_ns >= 0 and source_ns not in unclear else None
        if sample is None or reference is None:
            followed, last_ns = False, stamp_ns
            missing += 1
            continue
        y, coil_current = sample
        gap = last_ns is not None and abs(stamp_ns - last_ns) > RUN_GAP_NS
        starts_anew = math.isnan(coil_current) or gap
        unsure = (unsure or gap) and not math.isnan(coil_current)
        last_ns = stamp_ns
        answer = servo.step(stamp_ns, y, coil_current, extrapolated(*reference, age_ns * 1e-9))
        followed = followed or starts_anew
        current = currents.get(stamp_ns)
        # Stamps may follow no clock (lockstep); the notice has the recorder's.
        if not followed or current is None or logged_ns > valid_ns:
            continue
        logged = (*current, *numbers[:-1], *others.get(stamp_ns, current))
        pairs = zip(_COLUMNS, logged, (*answer, answer[0]) if answer else (math.nan,) * len(logged), strict=True)
        # The texts are equal where the bits are, and for every NaN, which means "none" whatever its bits.
        found = next((Difference(step, stamp_ns, *pair) for pair in pairs if pair[1].hex() != pair[2].hex()), None)
        if found and unsure:
            followed, began_running = False, began_running or not compared
            continue
        unsure = False
        compared += 1
        different += found is not None
        first = first or found
    return Audit(
        parameters.control.law, compared, different, steps - compared, missing, bool(changes), began_running, first
    )


def _rows(stream: StreamColumns, *columns: str) -> tuple[dict[int, tuple[float, ...]], dict[int, tuple[float, ...]]]:
    """Numbers by stamp of the first message of each, which the driver takes; and those of a later message with the same
    stamp and other bits."""

    def by_stamp(messages: StreamColumns) -> dict[int, tuple[float, ...]]:
        numbers = zip(*(messages.columns[name].tolist() for name in columns), strict=True)
        return dict(zip(messages.stamp.tolist(), numbers, strict=True))

    first = stream.by_stamp()
    same = first.taken(np.searchsorted(first.stamp, stream.stamp))
    other = [stream.columns[name].view(np.int64) != same.columns[name].view(np.int64) for name in columns]
    return by_stamp(first), by_stamp(stream.taken(np.flatnonzero(np.any(other, axis=0))))
