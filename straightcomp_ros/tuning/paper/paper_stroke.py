"""The compensated stroke of Fig. 8 and 9: forward and back on the machine of the parameter file."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from straightcomp_ros.analysis.metrics import Metrics, evaluate, true_error
from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, VERMILION
from straightcomp_ros.analysis.record import Motion, StrokeRecord, find_motion
from straightcomp_ros.control.sliding_mode import SlidingDesign
from straightcomp_ros.offline.starts import first_cycle, spread, values_of_starts
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.drawing import label, legend_above, sheet
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.surface import lag


class Figures(NamedTuple):
    """Of one start, m: true error peak to peak, and the largest |r − y| and |y| as the encoder sees them."""

    pp: float
    largest_error: float
    largest_y: float


@dataclass(frozen=True, eq=False)
class CompensatedStroke:
    """A run and its map, its figures, and those of all starts; the run is from the first of them."""

    record: StrokeRecord
    map: StraightnessMap
    metrics: Metrics
    starts: tuple[Figures, ...]
    claims: tuple[Claim, ...] = ()

    @property
    def motion(self) -> Motion:
        """The strokes of the run."""
        return find_motion(self.record)


def run_stroke(machine: Machine, law: str) -> CompensatedStroke:
    """One cycle under ``law`` from each start, everything else as the parameter file says; without claims as yet.

    Raises:
        ParameterError, SurveyError: the parameters are refused.
    """
    values = {node: dict(parameters) for node, parameters in machine.values.items()}
    values.setdefault("controller", {})["control.law"] = law
    runs = [first_cycle(one) for one in values_of_starts(values)]
    record, straightness = runs[0]
    found = tuple(_figures(*run) for run in runs)
    return CompensatedStroke(record, straightness, evaluate(record, straightness), found)


def _figures(record: StrokeRecord, straightness: StraightnessMap) -> Figures:
    window = find_motion(record).window
    error = float(np.abs(record.r - record.y)[window].max())
    return Figures(evaluate(record, straightness).true_pp or math.nan, error, float(np.abs(record.y)[window].max()))


def stroke_claim(
    name: str, paper: float | None, numbers: Iterable[float], unit: str, tolerance: float = 0.0, note: str = ""
) -> Claim:
    """The claim of a figure over the starts; arguments as of `Claim`."""
    over = spread(numbers)
    return Claim(name, paper, over.median, unit, tolerance=tolerance, note=note, range=(over.min, over.max))


def lag_share(stroke: CompensatedStroke, design: SlidingDesign) -> float:
    """Peak to peak in m of (2ζ/ωn) ṙ over the stroke: the error that the law's lag leaves, whatever the plant."""
    rate = np.gradient(stroke.record.r, stroke.record.time)[stroke.motion.window]
    return lag(design) * peak_to_peak(rate)


def draw_stroke(data: CompensatedStroke, title: str) -> Figure:
    """Error over slider position, by direction, and over time."""
    figure, (over_x, over_time) = sheet(title, rows=2, size=(8.0, 7.0))
    limit = 1.1 * 1e6 * float(np.abs((data.record.r - data.record.y)[data.motion.window]).max())
    _over_x(over_x, data)
    _over_time(over_time, data)
    for axes in (over_x, over_time):
        axes.set_ylim(-limit, limit)
        legend_above(axes, columns=2)
        axes.margins(x=0.01)
    return figure


def _over_x(axes: Axes, data: CompensatedStroke) -> None:
    error_um = (data.record.r - data.record.y) * 1e6
    for direction, colour in (("forward", BLACK), ("backward", VERMILION)):
        for stroke in data.motion.strokes:
            if stroke.direction != direction:
                continue
            inside = slice(stroke.start, stroke.stop)
            name = f"{direction}: {np.ptp(error_um[inside]):.2f} µm p-p"
            axes.plot(data.record.x[inside] * 1e3, error_um[inside], color=colour, linewidth=0.8, label=name, alpha=0.8)
    label(axes, "Error r − y over the stroke (encoder)", "slider position x / mm", "error / µm")


def _over_time(axes: Axes, data: CompensatedStroke) -> None:
    window = data.motion.window
    time = data.record.time[window]
    text = f"encoder: {data.metrics.encoder_pp * 1e6:.2f} µm p-p, {data.metrics.encoder_rms * 1e6:.3f} µm RMS"
    axes.plot(time, (data.record.r - data.record.y)[window] * 1e6, color=GREY, linewidth=0.6, label=text)
    truth = true_error(data.record, data.map)
    if truth is not None and data.metrics.true_pp is not None and data.metrics.true_rms is not None:
        text = f"true: {data.metrics.true_pp * 1e6:.2f} µm p-p, {data.metrics.true_rms * 1e6:.3f} µm RMS"
        axes.plot(time, truth[window] * 1e6, color=BLUE, linewidth=0.8, label=text)
    label(axes, "Error r − y over time, forward, pause and back", "time / s", "error / µm")
