"""Runs the graphs of several stages on this computer, each alone and then all at once, and compares their errors."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.cell.launcher import isolated_environment
from trials.bench.demo_strokes import Figures, errors_um, figures_of, started, worst_verdict


def measure(
    stages: Sequence[str],
    rounds: int,
    folder: Path,
    progress: Callable[[str, float], object] = lambda text, done: None,
) -> dict[str, Any]:
    """Run each stage alone, then all at once, ``rounds`` times in turns.

    Args:
        stages: their descriptions' files; each gets the namespace ``stage_1``, ``stage_2``, …
        rounds: strokes of each stage alone, and of all at once.
        folder: gets bags and logs.
        progress: called with what begins now and the finished fraction.

    Returns:
        By namespace the stage's file, the median p-p error of the strokes in µm, lost samples and the worst verdict
        ``alone`` and ``at_once``, and the ratio of the errors; ``in_order``: whether every run was.

    Raises:
        BenchFailed: a stroke failed.
    """
    named = {f"stage_{number}": stage for number, stage in enumerate(stages, start=1)}
    environment = isolated_environment()
    alone: dict[str, list[Any]] = {name: [] for name in named}
    at_once: dict[str, list[Any]] = {name: [] for name in named}
    steps = rounds * (len(named) + 1)
    for turn in range(rounds):
        for place, (name, stage) in enumerate(named.items()):
            progress(f"{name} alone", (turn * (len(named) + 1) + place) / steps)
            alone[name] += _strokes({name: stage}, folder / f"alone_{turn}", environment).values()
        progress("all at once", ((turn + 1) * (len(named) + 1) - 1) / steps)
        for name, figures in _strokes(named, folder / f"at_once_{turn}", environment).items():
            at_once[name].append(figures)
    found = {
        name: {"file": stage, "alone": _summary(alone[name]), "at_once": _summary(at_once[name])}
        for name, stage in named.items()
    }
    for figure in found.values():
        figure["ratio"] = figure["at_once"]["pp_um"] / figure["alone"]["pp_um"]
    verdicts = {figure[when]["verdict"] for figure in found.values() for when in ("alone", "at_once")}
    return {"stages": found, "in_order": verdicts == {IN_ORDER}}


def _summary(strokes: Sequence[Figures]) -> dict[str, Any]:
    errors = errors_um(strokes)
    return {
        "pp_um": statistics.median(errors),
        "worst_pp_um": max(errors),
        "lost_samples": sum(stroke["lost_samples"] for stroke in strokes),
        "verdict": worst_verdict(strokes),
    }


def _strokes(stages: Mapping[str, str], folder: Path, environment: Mapping[str, str]) -> dict[str, Figures]:
    """Figures of `straightcomp demo` of all these stages, run at once."""
    running = {
        name: started(["--namespace", name, "--stage", stage, "--output", str(folder / name)], environment)
        for name, stage in stages.items()
    }
    # All end before one is found to have failed.
    outputs = {name: process.communicate() for name, process in running.items()}
    return {name: figures_of(*output, f"{name} ({stages[name]})") for name, output in outputs.items()}
