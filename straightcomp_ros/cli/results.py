"""Results of runs on the terminal: tables of figures, and verdicts, also in JSON and as the exit code."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from straightcomp_ros.analysis.figure_words import in_words, with_digits
from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.cli.output import CommandFailed, console, print_json, print_warnings, printable, styled

if TYPE_CHECKING:
    from straightcomp_ros.analysis.judgement import Verdict
    from straightcomp_ros.control.laws import ControlParameters

    # The sweep takes longer to import than most verbs run.
    from straightcomp_ros.doctor import Finding
    from straightcomp_ros.offline.starts import Spread
    from straightcomp_ros.stage.description import StageParameters

_ROWS = {
    **dict.fromkeys(("encoder_pp_um", "true_pp_um", "encoder_rms_um", "true_rms_um"), 3),
    **dict.fromkeys(("uncompensated_pp_um", "residual_pp_um"), 2),
    **dict.fromkeys(("expected_samples", "received_samples", "lost_samples", "lost_commands"), 0),
    **dict.fromkeys(("latency_p50_us", "latency_p99_us"), 0),
}
"""Figures of a run on the terminal, and the digits of each."""


_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}
_ERROR = re.compile(r"((encoder|true|residual|residual_encoder)_(pp|rms)|(straightness_)?after)(_\w+)?_um")
"""Names of the figures that say nothing of the machine when a run is not in order."""


LONGEST_WHOLE = 20
"""Characters of a word that a table never breaks between lines: no number is longer."""


class FittingTable(Table):
    """Breaks texts between words where the terminal is narrow, and never a number; where not even that is enough, each
    row becomes lines of its own."""

    def add_row(self, *cells: object, **options: Any) -> None:  # type: ignore[override]
        """A row of texts, styled or not; what is neither becomes one."""
        super().add_row(*(cell if isinstance(cell, Text) else printable(str(cell)) for cell in cells), **options)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        columns = [(str(column.header), *map(str, column.cells)) for column in self.columns]
        widths = [max(map(cell_len, "\n".join(cells).split("\n"))) for cells in columns]
        least = [min(LONGEST_WHOLE, max(map(cell_len, " ".join(cells).split()), default=0)) for cells in columns]
        room = options.max_width - 3 * len(columns) - 1
        if sum(least) > room:
            yield Text(str(self.title))
            for first, *others in zip(*(cells[1:] for cells in columns), strict=True):
                yield Text(first)
                for column, cell in zip(columns[1:], others, strict=True):
                    yield Text(f"  {' '.join(column[0].split())}: {cell}")
            if self.caption:
                yield Text(str(self.caption))
            return
        while sum(widths) > room:
            widest = max(range(len(widths)), key=lambda k: widths[k] if widths[k] > least[k] else -1)
            widths[widest] -= 1
        for column, width in zip(self.columns, widths, strict=True):
            column.width = width
        yield from super().__rich_console__(console, options)


def titled_table(
    title: str, first: str, *others: str, left: Collection[str] = (), rows: Iterable[Sequence[object]] = ()
) -> Table:
    """A table; its first column and those named in ``left`` are left-aligned, the others right-aligned."""
    table = FittingTable(title=printable(title), title_justify="left")
    for heading in (first, *others):
        justify: Literal["left", "right"] = "left" if heading == first or heading in left else "right"
        table.add_column(printable(heading), justify=justify, overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def figures_table(title: str, figures: Mapping[str, Any]) -> Table:
    """Figures by name, in words and with their units."""
    found = ((*in_words(name), shown(value)) for name, value in figures.items())
    rows = ((words, value, unit) for words, unit, value in found)
    return titled_table(title, "figure", "value", "unit", left=("unit",), rows=rows)


def shown(value: Any) -> str:
    """A figure in a table; empty where there is none."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def marked(name: str, text: str, figures: Mapping[str, Any]) -> str | Text:
    """``text`` of the figure ``name`` in a table, marked if the verdict in ``figures`` makes it doubtful."""
    return doubtful(text) if _ERROR.fullmatch(name) and figures.get("verdict", IN_ORDER) != IN_ORDER else text


def doubtful(text: str) -> str | Text:
    """The text of a figure that is not the machine's: in another style, with a mark."""
    return styled((f"{text} !", "red")) if text else text


def results_table(figures: Mapping[str, Any], over_starts: Mapping[str, Spread] | None = None) -> Table:
    """Those figures that are there; one of ``over_starts``, median (min to max), takes the place of that of one run."""
    over_starts = over_starts or {}
    title = f"Straightness compensation, law '{figures['law']}'"
    table = titled_table(title, "figure", "value", "unit", left=("unit",))
    for key, digits in _ROWS.items():
        words, unit = in_words(key)
        if figures.get(key) is not None:
            value = over_starts[key].text(digits) if key in over_starts else with_digits(figures[key], digits)
            table.add_row(words, marked(key, value, figures), unit)
    return table


def timing_table(timing: Mapping[str, Mapping[str, Any]]) -> Table:
    """Each node's rate, lateness and longest time without a CPU; ``timing`` as in the figures of a demonstration."""
    columns = ("rate\n[Hz]", "overruns", "stalls", "lost", "late\np99", "max\n[µs]", "no CPU\n[ms]")
    table = titled_table("Timing of the nodes, from their diagnostics", "node", *columns)
    for node, values in timing.items():
        late = [values["timer_error_us"][key] for key in ("p99", "max")]
        numbers = (values["rate_hz"], values["overruns"], values["stalls"], values["lost_samples"], *late)
        table.add_row(node, *map(rounded, numbers), rounded(values["no_cpu_us"] * 1e-3, 1))
    return table


def rounded(value: float | None, digits: int = 0) -> str:
    """A number for a table; a dash where there is none."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def cycles_table(law: str, cycles: Sequence[Mapping[str, Any]]) -> Table:
    """True error of each cycle, figures as of :func:`results_table`."""
    title = f"True compensation error from cycle to cycle, law '{law}'"
    table = titled_table(title, "cycle", "p-p / µm", "RMS / µm")
    for number, each in enumerate(cycles, 1):
        cells = (marked(key, with_digits(each[key], n), each) for key, n in (("true_pp_um", 3), ("true_rms_um", 4)))
        table.add_row(str(number), *cells)
    return table


def print_verdict(verdict: Verdict, of: str = "") -> None:
    """The verdict as a line below a table; ``of`` names the run where there are several."""
    style = "green" if verdict.in_order else "red"
    console.print(f"Verdict{f' on {of}' if of else ''}: {verdict}", style=style)


def fail_unless_in_order(verdict: Verdict) -> None:
    """Raise CommandFailed, exit code 1, for a run that is not in order."""
    if not verdict.in_order:
        raise CommandFailed(f"not in order: {verdict.verdict}")


def warn_of_missing_margin(control: ControlParameters, stage: StageParameters) -> str | None:
    """Say on standard error which margin the law lacks on ``stage``; return the sentence, None if it lacks none."""
    # Only here: it imports scipy, which takes longer than what most verbs do.
    from straightcomp_ros.control.margins import missing_margin

    missing = missing_margin(control, stage)
    if missing is not None:
        print_warnings([f"{missing}; the controller of the graph refuses these, unless 'control.margins' is 'warn'"])
    return missing


def show_findings(found: Iterable[Finding], *, json: bool) -> int:
    """Print the findings of a check as they come; returns the exit code: 1 if one fails."""
    findings = []
    for finding in found:
        findings.append(finding)
        if not json:
            # Two columns, so that what is too long for a line goes on below its own beginning.
            grid = Table.grid(padding=(0, 2))
            remedy = (f"\n{finding.remedy}", "dim") if finding.remedy else ""
            state = styled((f"{finding.state:>4}", _COLOURS[finding.state]))
            grid.add_row(state, styled(f"{finding.name}: {finding.detail}", remedy))
            console.print(grid)
    counts = {state: sum(finding.state == state for finding in findings) for state in _COLOURS}
    if json:
        print_json({**counts, "checks": [dataclasses.asdict(finding) for finding in findings]})
    else:
        console.print(", ".join(f"{count} {state}" for state, count in counts.items()))
    return 1 if counts["fail"] else 0
