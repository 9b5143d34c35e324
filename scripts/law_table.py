"""Print the table of the laws in docs/accuracy.md, and below it each law's margins: Markdown, or JSON with --json.

Errors are medians over nine starts (min to max) of the whole stroke offline, with the shipped parameters. Percentiles
over uncertain machines are taken from a file, since they take minutes:

    straightcomp robustness --json > robustness.json
    python scripts/law_table.py --robustness robustness.json
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import LAWS, make_law
from straightcomp_ros.control.margins import loop_margins
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import STARTS, Spread, first_cycle, spreads, values_of_starts, with_values
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.paper.stroke import PAPER_PP_UM

SGN = "`smc` with sgn σ as printed"
NAMES = {
    "linear": "`linear`",
    "smc": "`smc`, with the map's rates fed forward",
    "smc_observer": "`smc_observer`",
}
"""First cell of each law's row."""
HEADS = (
    "`--law`",
    "paper [µm]",
    "p-p [µm]",
    "RMS [µm]",
    "RMS Δi_c [mA]",
    "p50 / p95 / worst of uncertain machines [µm]",
    "not in order",
    "µs per step",
)
MARGINS = {
    "gain_low": ("gain from", 2),
    "gain_high": ("to", 2),
    "phase_deg": ("phase [°]", 0),
    "longest_delay_samples": ("longest delay [samples]", 2),
}
"""By name in JSON: head in Markdown, digits."""
_TIMED_SAMPLES = 2000
_REPEATS = 5
_FIGURES = {
    "pp_um": ("true_pp_um", 1.0),
    "rms_um": ("true_rms_um", 1.0),
    "control_rms_step_mA": ("control_rms_step_A", 1e3),
    "control_activity_A": ("control_activity_A", 1.0),
}
"""By name the figure of `Metrics.to_display`, and its factor."""


def read_robustness(path: Path) -> dict[str, dict[str, Any]]:
    """By law what `straightcomp robustness --json` says of it.

    Raises:
        CommandFailed: the file cannot be read, or is no such result.
    """
    try:
        laws = json.loads(path.read_text("utf-8"))["laws"]
        return {
            law: {
                "robust_pp_um": {name: summary["pp_um"][name] for name in ("p50", "p95", "max")},
                "not_in_order": summary["not_in_order"],
            }
            for law, summary in laws.items()
        }
    except OSError as error:
        raise CommandFailed(f"file {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CommandFailed(f"file {path}: is no result of 'straightcomp robustness --json' ({error!r})") from error


def law_of(values: Values) -> Law:
    """The law that the controller of ``values`` runs; ParameterError if a parameter is refused."""
    controller = node_set(values).controller
    return make_law(controller.control, controller.stage)


def figures_of(values: Values, law: Law | None = None, starts: int = STARTS) -> dict[str, Any]:
    """Run one cycle from each of ``starts`` starts, and time the law's step on the samples of the first.

    Args:
        values: parameters by node and dotted name.
        law: replaces the law that ``values`` name; it need not be compilable.
        starts: number of starts.

    Returns:
        By name the median, least and largest of the true error, the RMS change of i_c from sample to sample, and
        Σ |Δ i_c| over the motion; and ``step_us``, the least processor time of several repetitions for one step.

    Raises:
        ParameterError, SurveyError: the parameters are refused.
        MetricsError: the stage does not move.
    """
    timed = law or law_of(values)
    samples: list[tuple[float, ...]] = []
    first, *others = values_of_starts(values, starts)
    simulation = Simulation(first, law=timed)
    record = simulation.run(
        observe=lambda sample, truth, reference, command, age: samples.append((sample.y, *reference, sample.current))
    )
    found = spreads(
        evaluate(*one).to_display() for one in ((record, simulation.map), *(first_cycle(one, law) for one in others))
    )
    return {
        **{name: found[figure].scaled(factor)._asdict() for name, (figure, factor) in _FIGURES.items()},
        "step_us": _step_time(timed, samples[len(samples) // 4 :][:_TIMED_SAMPLES]) * 1e6,
    }


def _step_time(law: Law, samples: Sequence[tuple[float, ...]]) -> float:
    """Processor time in s for one step of ``law``, from repeated runs over ``samples``, arguments of `Law.step`."""
    times = []
    for _ in range(_REPEATS):
        law.reset(samples[0][0])
        step = law.step
        started = time.process_time()
        for sample in samples:
            step(*sample)
        times.append(time.process_time() - started)
    return min(times) / len(samples)


def margins_of(values: Values) -> dict[str, float | None]:
    """Margins of the law that ``values`` name, on the stage as described; None where it has no linearisation."""
    stage = node_set(values).controller.stage
    try:
        margins = loop_margins(law_of(values), stage)
    except ValueError:
        return dict.fromkeys(MARGINS)
    return {
        "gain_low": margins.gain_low,
        "gain_high": margins.gain_high,
        "phase_deg": margins.phase,
        "longest_delay_samples": margins.longest_delay / stage.period,
    }


def chosen_laws(values: Values) -> dict[str, dict[str, dict[str, Any]]]:
    """Parameters of each row: all laws, then the one with sgn σ."""
    chosen = {law: with_values(values, "controller", {"control.law": law}) for law in LAWS}
    chosen[SGN] = with_values(values, "controller", {"control.law": "smc", "control.smc.boundary_layer": 0.0})
    return chosen


def rows(values: Values, robustness: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The table, one row for each of `chosen_laws`."""
    return [
        {"law": law, **figures_of(one), **robustness.get(law, {}), **margins_of(one)}
        for law, one in chosen_laws(values).items()
    ]


def cells(row: Mapping[str, Any]) -> list[str]:
    """One row of the table."""
    law = row["law"]
    errors = [
        Spread(**row[name]).text(digits) for name, digits in (("pp_um", 2), ("rms_um", 3), ("control_rms_step_mA", 1))
    ]
    paper = f"{PAPER_PP_UM[law]:.2f}" if law in PAPER_PP_UM else ""
    uncertain, failed = "", ""
    if "robust_pp_um" in row:
        percentiles = row["robust_pp_um"]
        uncertain = f"{percentiles['p50']:.2f} / {percentiles['p95']:.2f} / {percentiles['max']:.2f}"
        failed = str(row["not_in_order"])
    return [NAMES.get(law, law), paper, *errors, uncertain, failed, f"{row['step_us']:.1f}"]


def markdown(table: Sequence[Mapping[str, Any]]) -> str:
    """The table, and the margins of those laws that have some."""
    margins = [
        [NAMES.get(row["law"], row["law"]), *(f"{row[name]:.{digits}f}" for name, (_, digits) in MARGINS.items())]
        for row in table
        if row.get("gain_low") is not None
    ]
    heads = ["law", *(head for head, _ in MARGINS.values())]
    return f"{_grid(HEADS, [cells(row) for row in table])}\n\n{_grid(heads, margins)}"


def _grid(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (heads, ["---"] * len(heads), *lines))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robustness", type=Path, metavar="FILE", help="result of 'straightcomp robustness --json'")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args(arguments)
    try:
        robustness = read_robustness(options.robustness) if options.robustness else {}
    except CommandFailed as error:
        print(error, file=sys.stderr)
        return 2
    table = rows(shipped_parameters(), robustness)
    print(json.dumps({"laws": table}, ensure_ascii=False) if options.json else markdown(table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
