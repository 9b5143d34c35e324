"""Print the table of the laws that the README shows: Markdown, or JSON with --json.

One cycle of the whole stroke offline for each law, with the shipped parameters; how hard the coils work is also told
relative to the law as the paper writes it, with sgn σ (law smc, boundary layer 0). Percentiles over uncertain machines
are taken from a file, since they take minutes:

    straightcomp robustness --json > robustness.json
    python scripts/law_table.py --robustness robustness.json
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.comparison import LawFigures, Values, figures_of, law_of, with_values
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.control.margins import loop_margins
from straightcomp_ros.paper.machine import machine_from
from straightcomp_ros.parameter_file import read_parameter_file
from straightcomp_ros.share import share_path

SGN = "smc, sgn σ"
COLUMNS: Sequence[tuple[str, str, int]] = (
    ("pp_um", "p-p [µm]", 2),
    ("rms_um", "RMS [µm]", 3),
    ("control_rms_step_mA", "RMS Δi_c [mA]", 1),
    ("control_rms_step_relative", "of sgn's", 2),
    ("control_activity_A", "Σ\\|Δi_c\\| [A]", 0),
    ("control_activity_relative", "of sgn's", 2),
    ("step_us", "step [µs]", 1),
    ("robust_pp_p95_um", "p95 [µm]", 2),
    ("robust_pp_worst_um", "worst [µm]", 2),
    ("limit_cycles", "limit cycles", 0),
    ("gain_low", "gain from", 2),
    ("gain_high", "to", 2),
    ("phase_deg", "phase [°]", 0),
    ("longest_delay_samples", "longest delay [samples]", 2),
)
"""Name in JSON, head in Markdown, digits."""


class InputError(ValueError):
    """The file of the sweep is refused; the message says why."""


def read_robustness(path: Path) -> dict[str, dict[str, Any]]:
    """By law what `straightcomp robustness --json` says of it.

    Raises:
        InputError: the file cannot be read, or is no such result.
    """
    try:
        laws = json.loads(path.read_text("utf-8"))["laws"]
        return {
            law: {
                "robust_pp_p95_um": told["pp_um"]["p95"],
                "robust_pp_worst_um": told["pp_um"]["max"],
                "limit_cycles": told["limit_cycles"],
            }
            for law, told in laws.items()
        }
    except OSError as error:
        raise InputError(f"file {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"file {path}: is no result of 'straightcomp robustness --json' ({error!r})") from error


def margins_of(values: Values) -> dict[str, float | None]:
    """Margins of the law that ``values`` name, on its nominal plant; None where it has no linearisation."""
    machine = machine_from(values)
    period = 1.0 / machine.rate
    try:
        margins = loop_margins(
            law_of(values),
            machine.control.nominal,
            period=period,
            delay=machine.delay * period,
            amplifier_bandwidth=machine.plant.drive.bandwidth,
        )
    except ValueError:
        return dict.fromkeys(("gain_low", "gain_high", "phase_deg", "longest_delay_samples"))
    return {
        "gain_low": margins.gain_low,
        "gain_high": margins.gain_high,
        "phase_deg": margins.phase,
        "longest_delay_samples": margins.longest_delay / period,
    }


def row(law: str, figures: LawFigures, sgn: LawFigures) -> dict[str, Any]:
    """What is told of one run, beside the law with sgn σ."""
    return {
        "law": law,
        "pp_um": figures.pp * 1e6,
        "rms_um": figures.rms * 1e6,
        "control_rms_step_mA": figures.control_rms_step * 1e3,
        "control_rms_step_relative": figures.control_rms_step / sgn.control_rms_step,
        "control_activity_A": figures.control_activity,
        "control_activity_relative": figures.control_activity / sgn.control_activity,
        "step_us": figures.step_time * 1e6,
    }


def rows(values: Values, robustness: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The table: all laws, then the one with sgn σ."""
    chosen = {law: with_values(values, "controller", {"control.law": law}) for law in LAWS}
    chosen[SGN] = with_values(values, "controller", {"control.law": "smc", "control.design.boundary_layer": 0.0})
    figures = {law: figures_of(one) for law, one in chosen.items()}
    return [
        {**row(law, figures[law], figures[SGN]), **robustness.get(law, {}), **margins_of(one)}
        for law, one in chosen.items()
    ]


def markdown(table: Sequence[Mapping[str, Any]]) -> str:
    """The table in Markdown; columns of which no row knows anything are left out."""
    shown = [column for column in COLUMNS if any(one.get(column[0]) is not None for one in table)]
    lines = [
        "| law | " + " | ".join(head for _, head, _ in shown) + " |",
        "|---" * (len(shown) + 1) + "|",
    ]
    for one in table:
        numbers = ("" if one.get(name) is None else f"{one[name]:.{digits}f}" for name, _, digits in shown)
        lines.append(f"| {one['law']} | " + " | ".join(numbers) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robustness", type=Path, metavar="FILE", help="result of 'straightcomp robustness --json'")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args(arguments)
    try:
        robustness = read_robustness(options.robustness) if options.robustness else {}
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    table = rows(read_parameter_file(share_path("config/straightcomp.yaml")), robustness)
    print(json.dumps({"laws": table}, ensure_ascii=False) if options.json else markdown(table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
