"""How good a map is that is proposed from strokes, beside the old one and a fresh survey, on a guide that has moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.random import default_rng

from straightcomp_ros.fleet.history.rows import StrokeRow, checksum_of, table_of
from straightcomp_ros.fleet.history.strokes_of_bag import Recorded
from straightcomp_ros.fleet.maintenance.map_proposal import proposed_map
from straightcomp_ros.offline.starts import metrics_of_starts, spread
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey, load_map
from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.tuning.sweep.trial import mismeasured
from trials.bench.worn_stage import settled, simulated_rows

CYCLES = 24
"""Forward and backward: a day with a bag an hour."""
_SURVEY_NOISE = 0.025e-6
"""m; of a point of a survey, as of the shipped one."""
_READING_NOISE = 0.2e-6
"""m; of a single reading on a stroke: its bins of 10 mm, 66 samples at 0.3 m/s, are then as good as points."""


def measure(
    folder: Path,
    moved_um: float,
    seed: int = 0,
    cycles: int = CYCLES,
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Straightness of the simulated workpiece in µm, p-p, median of nine starts, with each map.

    Args:
        folder: for the surveys.
        moved_um: height in µm of the bump that the guide has got from x = 300 to 420 mm.
        seed: of the noise.
        cycles: from which the map is proposed, each forward and backward.
        progress: called with the fraction that is done.
    """
    random = default_rng(seed)
    old, guide = (find_survey(f"config/{name}_synthetic.csv") for name in ("survey", "guide"))
    ideal = read_survey(guide).runs[0]
    moved = replace(ideal, deviation=ideal.deviation + moved_um * 1e-6 * settled(ideal.x))
    true = folder / "moved_guide.csv"
    write_survey(true, Survey((moved,), str(true)), ["the simulated guide, moved"])
    runs = [Run(str(n), way, moved.x, moved.deviation) for n in (1, 2, 3) for way in ("forward", "backward")]
    fresh = folder / "fresh_survey.csv"
    write_survey(fresh, mismeasured(Survey(tuple(runs), str(fresh)), _SURVEY_NOISE, random), ["survey of that guide"])
    # Of the written file: the moved guide as the simulated machine has it.
    truth = load_map(MapParameters(file=str(true)))
    recorded = Recorded(stage="moved", map_checksum=checksum_of([old.read_bytes()]))
    rows: list[StrokeRow] = []
    for cycle in range(cycles):
        driver = {"simulated.truth.guide": str(true), "simulated.initial_y": 0.13e-6 * cycle}
        found = simulated_rows(
            {"driver": driver},
            recorded,
            lambda x: truth.deviations(x) + _READING_NOISE * random.standard_normal(x.size),
        )
        rows += found
        progress(0.5 * (cycle + 1) / cycles)
    proposal = proposed_map(table_of(StrokeRow, rows), old, 1.0)
    proposed = folder / "proposed_map.csv"
    proposal.built.write(proposed)
    maps = {"old": old, "proposed": proposed, "fresh": fresh}
    figures: dict[str, Any] = {"moved_um": moved_um, "strokes": proposal.strokes}
    for place, (name, file) in enumerate(maps.items(), 1):
        values = {"driver": {"simulated.truth.guide": str(true)}}
        values |= {node: {"stage.guide.file": str(file)} for node in ("feedforward", "controller")}
        residuals = [one.residual_pp * 1e6 for one in metrics_of_starts(values)]
        figures[f"{name}_um"] = spread(residuals)._asdict()
        progress(0.5 + 0.5 * place / len(maps))
    figures["proposed_to_fresh"] = figures["proposed_um"]["median"] / figures["fresh_um"]["median"]
    return figures
