"""Print the tables of docs/tuning.md: what the shipped stroke leaves with other values of one parameter, Markdown.

True error p-p and RMS in µm, RMS step of i_c in mA; each is the median of nine starts (min to max), as
`straightcomp simulate --starts 9` has them. Shipped values are bold. Two minutes.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.offline.starts import STARTS, Spread, Values, runs_of_starts, spreads, with_values
from straightcomp_ros.parameters.parameter_file import shipped_parameters

FIGURES = {"p-p": ("true_pp_um", 1.0, 2), "RMS": ("true_rms_um", 1.0, 3), "step of i_c": ("control_rms_step_A", 1e3, 1)}
"""Head of a row: name in `Metrics.to_display`, factor, digits."""


_BOTH = ("p-p", "step of i_c")


class Table(NamedTuple):
    """One parameter: head, law, name of the parameter, the values tried, rows, and the node that has it."""

    head: str
    law: str
    parameter: str
    values: tuple[float, ...]
    rows: tuple[str, ...] = _BOTH
    node: str = "controller"


TABLES = (
    Table("ε [m/s]", "smc", "control.smc.boundary_layer", (0.0008, 0.0016, 0.0032, 0.004, 0.008), tuple(FIGURES)),
    Table("ωn/2π [Hz]", "smc", "control.smc.natural_frequency", (20, 35, 50, 70)),
    Table("φ [1/s]", "smc", "control.smc.phi", (25, 50, 100, 200, 400)),
    Table("velocity estimate [Hz]", "smc", "control.smc.velocity_bandwidth", (50, 100, 1000)),
    Table("allowance", "smc_observer", "control.smc_observer.gain_allowance", (0.8, 1.2, 1.7, 2.2, 3.0)),
    Table("bandwidth [Hz]", "smc_observer", "control.smc_observer.bandwidth", (100, 150, 205, 280, 400)),
    Table("λ [1/s]", "smc_observer", "control.smc_observer.surface", (200, 400, 575, 800, 1200)),
    Table("κ [1/s]", "smc_observer", "control.smc_observer.reaching", (200, 300, 396, 600, 900)),
    Table("delay believed [samples]", "smc_observer", "control.smc_observer.delay", (0.0, 0.5, 0.88, 1.0)),
    Table("share m", "smc_observer", "control.smc_observer.velocity_share", (0.0, 0.15, 0.3, 0.5, 1.0)),
    Table("true delay [samples]", "smc_observer", "drive.delay", (0.05, 0.5, 1.0, 1.25, 2.0), node="stage"),
)


def over_starts(values: Values, count: int = STARTS) -> dict[str, Spread]:
    """Each of `FIGURES` over the starts, in its row's unit."""
    found = spreads(evaluate(*one).to_display() for one in runs_of_starts(values, count))
    return {row: found[name].scaled(factor) for row, (name, factor, _) in FIGURES.items()}


def values_of(shipped: Values, law: str, node: str = "controller", changes: Mapping[str, Any] | None = None) -> Values:
    """Parameters of one cell: the shipped ones under ``law``, with ``changes`` of a node."""
    return with_values(with_values(shipped, "controller", {"control.law": law}), node, changes or {})


def column(shipped: Values, table: Table, value: float) -> Values:
    """Parameters of one column of ``table``."""
    return values_of(shipped, table.law, table.node, {table.parameter: value})


def markdown(shipped: Values, table: Table) -> Iterator[str]:
    """The lines of one table."""
    at_present = shipped[table.node][table.parameter]
    heads = (f"**{value:g}**" if value == at_present else f"{value:g}" for value in table.values)
    yield f"| {table.head} | " + " | ".join(heads) + " |"
    yield "|---" * (len(table.values) + 1) + "|"
    columns = [over_starts(column(shipped, table, value)) for value in table.values]
    for row in table.rows:
        yield f"| {row} | " + " | ".join(one[row].text(FIGURES[row][2]) for one in columns) + " |"


def line(name: str, values: Values) -> str:
    """One case as a row of its own."""
    return f"| {name} | " + " | ".join(one.text(FIGURES[row][2]) for row, one in over_starts(values).items()) + " |"


def main() -> None:
    """Print all of them."""
    shipped = shipped_parameters()
    print("| law | " + " | ".join(FIGURES) + " |\n|---|---|---|---|")
    for law in ("linear", "smc", "smc_observer"):
        print(line(f"`{law}`", values_of(shipped, law)), flush=True)
    literal = values_of(shipped, "smc", changes={"control.smc.feedforward": False})
    print(line("`smc` without feedforward", literal))
    for law in ("smc", "smc_observer"):
        for coulomb in (0.2, 0.43, 1.0):
            friction = {"stage.friction.coulomb": coulomb, "stage.friction.static": round(1.5 * coulomb, 3)}
            print(line(f"`{law}`, F_C = {coulomb:g} N", values_of(shipped, law, "driver", friction)), flush=True)
    for table in TABLES:
        print(f"\n`{table.law}`")
        for text in markdown(shipped, table):
            print(text, flush=True)


if __name__ == "__main__":
    main()
