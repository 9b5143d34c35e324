"""Print the table of designs for the stages of test/stages: true p-p in µm, work of the coils in mA, Markdown.

    python -m scripts.design_table [stage …]            # two to three minutes a stage on one core
    python -m scripts.design_table --search [stage …]   # twice as long
    python -m scripts.design_table shipped slow_amplifier --delays 0.1 0.25 0.5 1   # what less delay is worth

Columns: the gains that are shipped, the closed form, the design, its worst of 200 uncertain machines, and the gains
with the least error that any search or design found, which are kept in test/stages/found_gains.json. Figures are
medians of nine starts; with --delays with the range of p-p and the margins of the designed loop.
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping
from typing import NamedTuple

from scripts.stage_files import STAGES, stage_names, stage_scenario
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.margins import loop_margins
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.offline.starts import STARTS, Spread, spread
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.tuning.design.automatic_design import Design, design_gains
from straightcomp_ros.tuning.design.feasible_gains import DesignError
from straightcomp_ros.tuning.design.gain_search import Judge, prepared_stroke, search
from straightcomp_ros.tuning.design.gains import closed_form, starts, with_gains

FOUND = STAGES / "found_gains.json"
LAW = "smc_observer"
HEADS = (
    *("stage", "shipped gains", "closed form", "design", "p50 / p95 / worst", "not in order", "rounds", "found"),
    "CPU / wall s",
)
DELAY_HEADS = (
    *("stage", "delay [samples]", "closed form: p-p [µm] / step [mA]", "designed"),
    *("gain", "phase [°]", "longest delay [samples]", "not in order"),
)
SEEDS = (11, 12)
"""Of the searches from which the best is kept."""


class Figures(NamedTuple):
    """p-p of the true error in m, and work of the coils in A: medians of nine starts."""

    pp: float
    work: float

    def __str__(self) -> str:
        return f"{self.pp * 1e6:.3f} / {self.work * 1e3:.2f}"


def found_gains() -> dict[str, dict[str, float]]:
    """The gains with the least error that a search or a design found, by stage."""
    return json.loads(FOUND.read_text(encoding="utf-8")) if FOUND.is_file() else {}


def best_found(name: str, scenario: Scenario, gains: Mapping[str, float]) -> Figures:
    """Keep ``gains`` if they leave less error than those that are kept; the figures of the better ones."""
    rounded = {gain: float(f"{value:.5g}") for gain, value in gains.items()}
    kept = found_gains().get(name)
    ours, theirs = figures_of(scenario, rounded), figures_of(scenario, kept) if kept else None
    if theirs is not None and theirs.pp <= ours.pp:
        return theirs
    write_whole(FOUND, json.dumps({**found_gains(), name: rounded}, indent=1) + "\n")
    return ours


def search_long(name: str, evaluations: int) -> None:
    """Search on one stage from several seeds and from the gains that are kept."""
    scenario = stage_scenario(name)
    judge = Judge(scenario, LAW, 0.0)
    kept = found_gains().get(name)
    begin = starts(LAW, closed_form(scenario, LAW)) + ([kept] if kept else [])
    for seed in SEEDS:
        best = search(judge, begin, evaluations=evaluations, seed=seed, jobs=1)[0]
        begin.append(dict(best.gains))
    print(name, best_found(name, scenario, best.gains), flush=True)


def over_starts(scenario: Scenario, law: str, gains: Mapping[str, float]) -> tuple[Spread, Spread]:
    """p-p in m and work of the coils in A that ``gains`` leave on the stage as described, over the starts."""
    stage, stroke = scenario.description, prepared_stroke(scenario)
    made = make_law(with_gains(next(iter(scenario.controls.values())), law, gains), stage)
    runs = [stroke.run(made, stage.delay, start) for start in range(STARTS)]
    return spread(run.pp for run in runs), spread(run.work for run in runs)


def figures_of(scenario: Scenario, gains: Mapping[str, float], law: str = LAW) -> Figures:
    """Figures of ``gains`` on the stage as described."""
    return Figures(*(one.median for one in over_starts(scenario, law, gains)))


def row_of_delay(name: str, delay: float, quiet: float, law: str, evaluations: int, machines: int) -> str:
    """One line of the table of delays: one stage whose commands are ``delay`` samples late."""
    scenario = stage_scenario(name, law, delay)
    stage, control = scenario.description, scenario.controls[law]

    def figures(gains: Mapping[str, float]) -> str:
        pp, work = over_starts(scenario, law, gains)
        return f"{pp.scaled(1e6).text(3)} / {work.median * 1e3:.2f}"

    ours, head = f"| `{name}` | {delay:g}", figures(closed_form(scenario, law))
    try:
        design = design_gains(scenario, law, quiet=quiet, evaluations=evaluations, machines=machines, jobs=1)
    except DesignError as error:
        return f"{ours} | {head} | refused: {error} |"
    margins = loop_margins(make_law(with_gains(control, law, design.values), stage), stage, with_current=True)
    gain = f"{margins.gain_low:.2f} to {margins.gain_high:.2f}"
    late = f"{margins.longest_delay / stage.period:.2f}"
    failed = len(design.verification.not_in_order)
    return f"{ours} | {head} | {figures(design.values)} | {gain} | {margins.phase:.0f} | {late} | {failed} |"


def row(name: str, quiet: float, law: str, evaluations: int, machines: int) -> str:
    """One line of the table."""
    scenario = stage_scenario(name)
    shipped = figures_of(scenario, {}, law)
    began, cpu = time.monotonic(), time.process_time()
    try:
        # In this process: the CPU time of others would not be counted.
        design = design_gains(scenario, law, quiet=quiet, evaluations=evaluations, machines=machines, jobs=1)
    except DesignError as error:
        return f"| {name} | {shipped} | refused: {error} |"
    found = best_found(name, scenario, design.values) if law == LAW else ""
    seconds = f"{time.process_time() - cpu:.0f} / {time.monotonic() - began:.0f}"
    return f"| {name} | {shipped} | {designed(design)} | {found} | {seconds} |"


def designed(design: Design) -> str:
    """The cells of a design: closed form, design, its sweep."""
    sweep = design.verification
    at = [str(Figures(one.pp.median, one.work.median)) for one in (design.start_figures, design.figures)]
    swept = " / ".join(f"{sweep.percentiles('pp')[name] * 1e6:.2f}" for name in ("p50", "p95", "max"))
    return " | ".join([*at, swept, str(len(sweep.not_in_order)), str(design.rounds)])


def main(arguments: list[str] | None = None) -> int:
    """Print the table, or search."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="*", help="names of stages; all if none")
    parser.add_argument("--search", action="store_true", help="a long search, kept in test/stages/found_gains.json")
    parser.add_argument("--evaluations", type=int, default=400, help="candidates of each search")
    parser.add_argument("--machines", type=int, default=200, help="uncertain machines of the verification")
    parser.add_argument("--quiet", type=float, default=0.0, help="0 for the least error, 1 for the quietest coils")
    parser.add_argument("--law", default=LAW, help="law to design")
    parser.add_argument("--delays", type=float, nargs="+", metavar="D", help="each stage with each delay, in samples")
    options = parser.parse_args(arguments)
    names = options.stages or stage_names()
    if unknown := sorted(set(names) - set(stage_names())):
        print(f"stage {unknown[0]!r}; allowed: {', '.join(stage_names())}", file=sys.stderr)
        return 2
    if options.search:
        for name in names:
            search_long(name, options.evaluations)
        return 0
    made = (options.quiet, options.law, options.evaluations, options.machines)
    heads, lines = HEADS, (row(name, *made) for name in names)
    if options.delays:
        heads, lines = DELAY_HEADS, (row_of_delay(name, delay, *made) for name in names for delay in options.delays)
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for line in lines:
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
