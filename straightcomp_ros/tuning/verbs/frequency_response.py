"""Measure the frequency responses of plant and loop: a multisine is added to the commands, at rest or in motion.

Without --graph the machine is the simulated stage, in simulated time.

Prints the margins as measured, compared with those of the description in closed form, and says whether the description
explains the plant: within 1 dB and 5°, or within the measurement's confidence, wherever the coherence is above 0.9. If
it does not, the exit code is 1. The margins are those of the frequencies with a coherence above 0.9.
"""

import argparse
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.cli.options import (
    PICTURES,
    add_force,
    add_json,
    add_parameter_options,
    chosen_parameters,
    output_file,
    output_folder,
)
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written, working
from straightcomp_ros.cli.results import titled_table
from straightcomp_ros.control.excitation import MultisineParameters, suited_multisine
from straightcomp_ros.parameters.declaration import declarations, from_mapping
from straightcomp_ros.parameters.node_parameters import Values, node_parameters
from straightcomp_ros.parameters.output_files import making
from straightcomp_ros.tuning.frequency_response.measured_response import (
    WITHIN_DB,
    WITHIN_DEG,
    ComparedResponse,
    margin_rows,
    measure_simulated,
)
from straightcomp_ros.tuning.verbs import add_graph_option, graph_access, refuse_parameters_of_running

SUMMARY = "measure plant, open loop, sensitivity and margins"
PURPOSE = "tune"
_BY_STAGE = {
    "current": "a quarter of the bias current, or the highest current over 3.6 if that is less; 0.25 A on the shipped "
    "stage",
    "travel": "0.0003 m, or 0.35 of the way to the stop if that is less",
}
"""Defaults that depend on the stage, in words."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    for one in declarations(MultisineParameters):
        unit = f" {one.unit}" if one.unit else ""
        text = f"{one.description} (default: {_BY_STAGE.get(one.name, f'{one.default:g}{unit}')})"
        add(f"--{one.name}", type=one.kind, metavar=one.unit or "N", help=text)
    add_graph_option(parser)
    add("--moving", action="store_true", help="measure while the stage makes strokes, not at rest")
    add("--plot", "--output", "-o", metavar="FILE", help="save Bode and Nyquist plots (PNG, SVG or PDF; formerly -o)")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    refuse_parameters_of_running(options, "--stage", "--law", "--params-file", "--set")
    values = chosen_parameters(options)
    plot = output_file(options, "--plot", PICTURES)
    asked = {one.name: getattr(options, one.name) for one in declarations(MultisineParameters)}
    chosen = {name: value for name, value in asked.items() if value is not None}
    # What is refused is refused before a graph is started.
    from_mapping(MultisineParameters, chosen)
    with working("measuring") as advance:
        if options.graph is None:
            excitation = _excitation(values, chosen)
            found = measure_simulated(values, excitation, moving=options.moving, progress=advance)
        else:
            found, values = _measure_running(options, values, chosen)
    name = node_parameters("controller", values).stage.name
    if plot is not None:
        # Only here: matplotlib takes longer to import than the measurement.
        from straightcomp_ros.tuning.frequency_response.response_plot import plot_response

        plot_response(found, plot, f"Stage '{name}' under law '{found.law}'")
    if options.json:
        print_json({"stage": name, "moving": options.moving, **_figures(found)})
    else:
        _print(found, name)
        if plot is not None:
            print_written(plot, then="compare it with what straightcomp stage show says of the margins")
    if not found.explained:
        raise CommandFailed(_verdict(found))


def _excitation(values: Values, chosen: Mapping[str, Any]) -> MultisineParameters:
    """What is not ``chosen`` is as the stage bears it."""
    return suited_multisine(node_parameters("controller", values).stage, **chosen)


def _measure_running(
    options: argparse.Namespace, values: Values, chosen: Mapping[str, Any]
) -> tuple[ComparedResponse, Values]:
    """The response of a graph's loop, and its parameters.

    The bag is kept next to the plot, if there is one, in a folder of its own: others may have bags and parameters.
    """
    with ExitStack() as stack:
        if options.plot:
            plot = Path(options.plot)
            folder = output_folder("--output", str(plot.with_name(f"{plot.stem}_graph"))).resolve()
            names = ("bags", "logs", "parameters.yaml")
            folder = stack.enter_context(making(folder, names, force=options.force))
        else:
            folder = Path(stack.enter_context(TemporaryDirectory()))
        access = stack.enter_context(graph_access(options, values, folder))
        access.report("frequency response")
        # With --graph running the stage is that of its nodes.
        excitation = _excitation(access.values, chosen)
        return access.machine.response(access.values, excitation, moving=options.moving), access.values


def _figures(found: ComparedResponse) -> dict[str, Any]:
    measured, (gain, phase) = found.measured, found.deviations
    of_measured, of_model = found.margins
    names = ("plant", "open_loop", "sensitivity")
    curves = {
        name: {**_curve(getattr(measured.response, name)), "radius_95": getattr(measured, f"{name}_radius").tolist()}
        for name in names
    }
    return {
        "law": found.law,
        "duration_s": found.duration,
        "clipped_samples": found.clipped,
        "late_share": found.late_share,
        "speed_rms_mm_s": measured.speed * 1e3,
        "friction_damping_Ns_m": found.damping,
        "margins": of_measured._asdict(),
        "model_margins": of_model._asdict(),
        "model_explains_the_plant": found.explained,
        "modes": [mode.to_display() for mode in found.mechanics.modes],
        "frequency_Hz": measured.frequencies.tolist(),
        "coherence": measured.coherence.tolist(),
        **curves,
        **{f"model_{name}": _curve(getattr(found.model, name)) for name in names},
        "deviation_dB": gain.tolist(),
        "deviation_deg": phase.tolist(),
    }


def _curve(values: Any) -> dict[str, list[float]]:
    return {"real": values.real.tolist(), "imag": values.imag.tolist()}


def _print(found: ComparedResponse, name: str) -> None:
    rows = margin_rows(*(one._asdict() for one in found.margins))
    title = f"Loop of stage '{name}' under law '{found.law}'"
    console.print(titled_table(title, "margin", "measured", "description", rows=rows))
    if found.explained:
        console.print(_verdict(found), style="green")
    for mode in found.mechanics.modes:
        console.print(mode.text[0].upper() + mode.text[1:])
    if found.lateness:
        notes.print(found.lateness)
    if found.clipped:
        notes.print(f"The current limit cut {found.clipped} samples of the excitation: take less current")
    notes.print(
        f"Friction is taken as the damping that it equals at {with_digits(found.measured.speed * 1e3, 2)} mm/s RMS: "
        f"{with_digits(found.damping, 0)} N·s/m. straightcomp design and stage check leave it out: their margins are "
        "smaller, and hold for a platform that slides",
    )


def _verdict(found: ComparedResponse) -> str:
    """Whether the description explains the plant, in a sentence."""
    coherent = found.measured.coherent
    if not coherent.any():
        return "no frequency has a coherence above 0.9: take more current"
    gain, phase = found.largest_deviations
    return (
        f"the description {'explains' if found.explained else 'does not explain'} the plant: largest deviation "
        f"{gain:.2f} dB and {phase:.1f}° at {coherent.sum()} of {coherent.size} frequencies with a coherence above 0.9 "
        f"(allowed: {WITHIN_DB:g} dB, {WITHIN_DEG:g}°, or what is within the measurement's confidence)"
    )
