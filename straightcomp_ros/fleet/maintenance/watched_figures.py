"""The figures of a stroke that are watched for wear, and how small a change of each is noise."""

from typing import NamedTuple


class Watched(NamedTuple):
    """A figure.

    Attributes:
        name: column of the store; :data:`GUIDE` is made from ``guide_change_um``.
        words: for people.
        unit: of its values.
        relative, absolute: least scatter from day to day that is assumed, as a fraction of the level and in the unit: a
            figure that hardly scatters during its baseline must not make an alarm of every tremor.
        falling: whether a fall is watched too; of the others only a rise is bad.
    """

    name: str
    words: str
    unit: str
    relative: float = 0.002
    absolute: float = 0.0
    falling: bool = False


GUIDE = "guide_change_pp_um"
"""Change of the guide's profile since the baseline, p-p beside a line, by the displacement sensor."""
FRICTION, STIFFNESS, AMPLIFIER = "friction_A", "stiffness_A_per_m", "amplifier_bandwidth_Hz"
LATENCY, LATE, LOST = "latency_p50_us", "latency_p99_us", "lost_samples"
ERROR, ERROR_PP, WORK, ACTIVITY = "encoder_rms_um", "encoder_pp_um", "coil_work_A2s", "control_activity_A"

WATCHED = (
    Watched(GUIDE, "change of the guide", "µm", absolute=0.002),
    Watched(FRICTION, "friction", "A", falling=True),
    Watched(STIFFNESS, "stiffness", "A/m", falling=True),
    Watched(AMPLIFIER, "bandwidth of the amplifier", "Hz", falling=True),
    Watched(LATENCY, "latency, median", "µs", absolute=1.0),
    Watched(LATE, "latency, 99th percentile", "µs", absolute=5.0),
    Watched(LOST, "lost samples in a stroke", "", absolute=1.0),
    Watched(ERROR, "error, RMS", "µm"),
    Watched(ERROR_PP, "error, p-p", "µm"),
    Watched(WORK, "work of the coils", "A²s", falling=True),
    Watched(ACTIVITY, "activity of the command", "A"),
)
BY_NAME = {one.name: one for one in WATCHED}
