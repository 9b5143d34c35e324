"""Tables for people: our figures beside the paper's."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table

from straightcomp_ros.paper.published import PEAK_TO_PEAK_UM

if TYPE_CHECKING:
    # The sweep takes longer to import than most verbs run.
    from straightcomp_ros.offline.sweep.starts import Spread

_ROWS = (
    ("encoder_pp_um", "compensation error p-p, encoder", "µm", 3),
    ("true_pp_um", "compensation error p-p, true", "µm", 3),
    ("encoder_rms_um", "compensation error RMS, encoder", "µm", 3),
    ("true_rms_um", "compensation error RMS, true", "µm", 3),
    ("uncompensated_pp_um", "straightness p-p before (ISO 230-1)", "µm", 2),
    ("residual_pp_um", "straightness p-p after (ISO 230-1)", "µm", 2),
    ("expected_samples", "samples expected", "", 0),
    ("received_samples", "samples received", "", 0),
    ("lost_samples", "samples lost", "", 0),
    ("lost_commands", "samples without a command", "", 0),
    ("latency_p50_us", "loop latency p50", "µs", 0),
    ("latency_p99_us", "loop latency p99", "µs", 0),
)


def titled_table(title: str, first: str, *others: str, left: Collection[str] = ()) -> Table:
    """An empty table; its first column and those named in ``left`` are left-aligned, the others right-aligned."""
    table = Table(title=title, title_justify="left")
    table.add_column(first, no_wrap=True)
    for heading in others:
        # Rich takes [ms] for markup.
        table.add_column(escape(heading), justify="left" if heading in left else "right")
    return table


def figures_table(title: str, figures: Mapping[str, Any]) -> Table:
    """Figures by name."""
    table = titled_table(title, "figure", "value")
    for name, value in figures.items():
        table.add_row(name, shown(value))
    return table


def shown(value: Any) -> str:
    """A figure in a table; empty where there is none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def results_table(figures: Mapping[str, Any], over_starts: Mapping[str, Spread] | None = None) -> Table:
    """Those figures that are there, and the paper's beside the true p-p error.

    A figure of ``over_starts`` takes the place of that of one run, as median (min to max).
    """
    over_starts = over_starts or {}
    law = figures["law"]
    title = f"Straightness compensation, law '{law}'"
    table = titled_table(title, "figure", "value", "unit", "paper", left=("unit",))
    for key, words, unit, digits in _ROWS:
        if figures.get(key) is not None:
            paper = f"{PEAK_TO_PEAK_UM[law]:.2f}" if key == "true_pp_um" and law in PEAK_TO_PEAK_UM else ""
            value = over_starts[key].text(digits) if key in over_starts else f"{figures[key]:.{digits}f}"
            table.add_row(words, value, unit, paper)
    return table


def timing_table(timing: Mapping[str, Mapping[str, Any]]) -> Table:
    """Each node's rate, how late its loop woke up, and the longest time for which it got no CPU.

    ``timing`` as in the figures of a demonstration."""
    columns = ("rate [Hz]", "overruns", "lost", "late p50 [µs]", "p99", "max", "no CPU [ms]")
    table = titled_table("Timing of the nodes, from their diagnostics", "node", *columns)
    for node, values in timing.items():
        late = values["timer_error_us"]
        table.add_row(
            node,
            rounded(values["rate_hz"]),
            str(values["overruns"]),
            str(values["lost_samples"]),
            *(rounded(late[key]) for key in ("p50", "p99", "max")),
            rounded(values["no_cpu_us"] * 1e-3, 1),
        )
    return table


def rounded(value: float | None, digits: int = 0) -> str:
    """A number for a table; a dash where there is none."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def cycles_table(law: str, cycles: Sequence[Mapping[str, Any]]) -> Table:
    """True error of each cycle, figures as of :func:`results_table`."""
    table = titled_table(f"True compensation error from cycle to cycle, law '{law}'", "cycle", "p-p / µm", "RMS / µm")
    for number, figures in enumerate(cycles, 1):
        table.add_row(str(number), f"{figures['true_pp_um']:.3f}", f"{figures['true_rms_um']:.4f}")
    return table


def can_tables(figures: Mapping[str, Any]) -> list[Table]:
    """Costs and times, faults, and the closed loop under faults; ``figures`` as `straightcomp bench can --json`."""
    costs = titled_table("CAN path", "part", "µs")
    for name, cost in figures["codec"].items():
        costs.add_row(f"pack {name}", f"{cost['pack_us']:.2f}")
        costs.add_row(f"unpack {name}", f"{cost['unpack_us']:.2f}")
    costs.add_row("send a frame to the hub", f"{figures['send_us']:.1f}")
    costs.add_row("receive a frame from the hub", f"{figures['receive_us']:.1f}")
    for key in ("p50", "p99", "max"):
        costs.add_row(f"round trip {key}", f"{figures['round_trip_us'][key]:.0f}")
    title = f"Faults, {figures['frames']} frames of each kind on each kind of bus"
    faults = titled_table(title, "kind", "injected", "detected")
    for kind, count in figures["faults"].items():
        faults.add_row(kind, str(count["injected"]), str(count["detected"]))
    faults.add_row("wrong samples used unflagged", "", str(figures["unflagged_wrong"]))
    columns = ("faults", "latched", "servo on", "on beyond a fault")
    loops = titled_table("Closed loop under all faults together", "bus", *columns)
    for bus, loop in figures["closed_loop"].items():
        latched = sum(loop["latched"].values())
        loops.add_row(bus, str(loop["injected"]), str(latched), f"{loop['on']:.0%}", str(loop["unsafe"]))
    return [costs, faults, loops]
