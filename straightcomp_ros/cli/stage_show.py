"""Show what follows from the description of a stage: stiffnesses, poles, counts, demands, margins, bus load."""

import argparse
import math
from typing import Any

from straightcomp_ros.cli.law_tables import titled_table
from straightcomp_ros.cli.output import console, print_json
from straightcomp_ros.cli.parameter_options import add_stage_argument, stage_values
from straightcomp_ros.doctor.stage_findings import Consequences, consequences
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.straightness.guide_map import load_map

SUMMARY = "show what follows from a description: stiffnesses, poles, counts, margins"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_stage_argument(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    values = stage_values(options)
    controller = node_parameters("controller", values)
    stage = controller.stage
    found = consequences(stage, controller.control, load_map(stage.guide))
    figures = _figures(found)
    if options.json:
        print_json({"name": stage.name, "law": controller.control.law, **{key: value for key, _, _, value in figures}})
        return
    table = titled_table(
        f"Stage '{stage.name}', law '{controller.control.law}'", "what follows", "value", "unit", left=("unit",)
    )
    for _, words, unit, value in figures:
        table.add_row(words, "the law switches" if value is None else f"{value:.4g}", unit)
    console.print(table)


def _figures(found: Consequences) -> list[tuple[str, str, str, float | None]]:
    """Key, words, unit and value of each figure."""
    margins: Any = found.margins

    def of_loop(name: str) -> float | None:
        return None if margins is None else float(getattr(margins, name))

    return [
        ("current_stiffness_N_per_A", "K_i, force per current", "N/A", found.current_stiffness),
        ("position_stiffness_N_per_m", "K_y, negative stiffness of the magnets", "N/m", found.position_stiffness),
        ("unstable_pole_Hz", "unstable pole of the platform", "Hz", found.unstable_pole / (2.0 * math.pi)),
        ("dead_time_ms", "dead time: hold, delay, amplifier", "ms", found.dead_time * 1e3),
        ("difficulty", "unstable pole times dead time (easy below 0.5)", "", found.difficulty),
        ("correction_um", "largest correction, to each side", "µm", found.correction * 1e6),
        ("reference_speed_um_per_s", "largest speed of the reference", "µm/s", found.reference_speed * 1e6),
        ("reference_acceleration", "largest acceleration of the reference", "m/s²", found.reference_acceleration),
        ("breakaway_current_A", "current that overcomes static friction", "A", found.breakaway_current),
        ("holding_current_A", "largest current of a stroke", "A", found.holding_current),
        ("dac_force_mN", "force of one D/A step", "mN", found.dac_force * 1e3),
        (
            "dac_displacement_nm",
            "displacement of one D/A step against the bristles",
            "nm",
            found.dac_displacement * 1e9,
        ),
        ("encoder_floor_um", "p-p error that the encoder's count leaves", "µm", found.encoder_floor * 1e6),
        ("gain_low", "loop is stable from a gain of", "", of_loop("gain_low")),
        ("gain_high", "loop is stable up to a gain of", "", of_loop("gain_high")),
        ("phase_deg", "phase margin", "°", of_loop("phase")),
        ("longest_delay_s", "longest delay of commands", "s", of_loop("longest_delay")),
        ("can_load", "classic CAN of 1 Mbit/s busy", "", found.can_load),
        ("can_fd_load", "CAN FD of 5 Mbit/s busy", "", found.can_fd_load),
    ]
