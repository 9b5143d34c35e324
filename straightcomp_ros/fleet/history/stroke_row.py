"""One stroke of one bag as a row of the store's table ``strokes``.

Figures have the names and units of `straightcomp evaluate --json`. A figure that the bag does not tell is null.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from straightcomp_ros.fleet.history.row_columns import column

BIN_MM = 10
"""Width of the bins over x. Bin k of a stroke begins at ``bins_from_mm`` + 10 k."""
PARTITIONS = ("stage", "month")
"""Columns that the folders of the store name, so that a file does not repeat them: name of the stage, and month
YYYY-MM in which the bag's first stroke began, UTC."""


@dataclass(frozen=True)
class StrokeRow:
    """The row; its partition is (stage, month)."""

    checksum: str = column("BLAKE2b of the bag's files: the bag's key, the same wherever the bag lies")
    bag: str = column("name under which the bag was recorded")
    stroke: int = column("number of the stroke in its bag, from 1")
    start: datetime = column("when the stroke began, UTC, by the stamps of the samples")
    identity: str | None = column("name and checksum of the stage's description")
    law: str = column("control law")
    direction: str = column("forward or backward")
    duration_s: float = column("duration of the stroke")
    travel_mm: float = column("its travel in x")
    encoder_pp_um: float = column("compensation error r − y as the encoder sees it, p-p")
    encoder_rms_um: float = column("the same, RMS about zero")
    true_pp_um: float | None = column("true compensation error, p-p; simulated machines only")
    true_rms_um: float | None = column("the same, RMS about zero")
    before_least_squares_um: float = column("straightness of the guide beside the least squares line (ISO 230-1)")
    before_end_points_um: float = column("the same beside the line through the end points")
    after_least_squares_um: float = column("straightness of the workpiece beside the least squares line")
    after_end_points_um: float = column("the same beside the line through the end points")
    control_activity_A: float = column("Σ |Δi_c| of the commands")
    coil_work_A2s: float = column("∫ i_c² dt of the commands: heat in the coils for each ohm")
    friction_A: float | None = column("friction as current: half the hysteresis of the coil current over y")
    stiffness_A_per_m: float | None = column("slope of the coil current over y: K̄_y / K̄_i")
    amplifier_bandwidth_Hz: float | None = column("bandwidth of the amplifier")
    latency_p50_us: float | None = column("time from a sample to the arrival of its command, median")
    latency_p99_us: float | None = column("the same, 99th percentile")
    expected_samples: int = column("samples that the clock took during the stroke")
    lost_samples: int = column("of these, samples that the bag lacks")
    unanswered_samples: int = column("samples in the bag without reference or command")
    saturated_samples: int = column("samples with the command at the current limit")
    amplifier_off_samples: int = column("samples with the amplifier off")
    stick_slip_events: int = column("how often the platform stuck and slipped")
    faults: list[str] = column("faults of the driver latched in the stroke or before the next one, see docs/safety.md")
    verdict: str = column("verdict on the stroke, see docs/accuracy.md")
    reason: str = column("the verdict's reason, with numbers")
    bins_from_mm: int = column("x at which the first bin begins, a multiple of the bins' width of 10 mm")
    error_bins_um: list[float | None] = column("mean error r − y in each bin; null without a sample there")
    residual_bins_um: list[float | None] = column(
        "mean deviation of the workpiece in each bin, beside the least squares line: true positions where they are "
        "known, else the map's and the encoder's"
    )
    current_bins_A: list[float | None] = column("mean command i_c in each bin")
    guide_change_um: list[float | None] | None = column(
        "deviation of the guide by the displacement sensor, minus the map's, in each bin; null without a sensor"
    )
    parameters_checksum: str | None = column("BLAKE2b of the parameters of driver, feedforward and controller")
    map_checksum: str | None = column("BLAKE2b of the attached map")
    software_version: str | None = column("version of the package that recorded the bag")
    software_revision: str | None = column("its git revision")
    host: str | None = column("computer that recorded the bag")
