"""Step `certificate`: an HTML file that prints well without a network, the same as JSON, and the tuned parameters.

Its first line is the conclusion, then follow the machine, a summary, and the evidence. A tolerance is kept if the
straightness is within it with its expanded uncertainty (ISO 14253-1: who states it bears the uncertainty).
"""

import base64
import datetime
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from straightcomp_ros.analysis.figure_words import heading
from straightcomp_ros.analysis.html_page import blocks, html_page, with_code, worded
from straightcomp_ros.analysis.straightness_statement import budget_rows, with_uncertainty
from straightcomp_ros.bags.information import origin
from straightcomp_ros.parameters.declaration import declarations, to_mapping
from straightcomp_ros.parameters.output_files import json_text, plain, write_whole
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import find_survey, load_map
from straightcomp_ros.tuning.commissioning import FIGURES, LIMITS, LOOP, PAGE, STROKE, TUNED
from straightcomp_ros.tuning.commissioning.acceptance import Check, limited, stroke_checks
from straightcomp_ros.tuning.commissioning.closed_loop import LEAST_GAIN, LEAST_PHASE
from straightcomp_ros.tuning.commissioning.machine import Outcome, Work
from straightcomp_ros.tuning.design.error_budget import BudgetEntry, remarks
from straightcomp_ros.tuning.frequency_response.measured_response import margin_rows
from straightcomp_ros.tuning.identification.estimate import DERIVED

_LATER = "In `limits.yaml`, for `straightcomp evaluate --limits`."
_BUDGET = """\
Simulated with the machine as found: what would be left if a cause were gone. The error of the survey adds to each:
{:.3g} µm RMS at each of its points (`stage.uncertainty.map_noise`); by its own runs, {}.
The platform follows it, and no encoder of this stage sees it."""
_LINE = "minimum_zone"
"""The reference line of the summary: ISO 230-1:2012, 3.4 defines straightness by it."""
_STRAIGHTNESS = """\
By the map and the encoder, with the expanded uncertainty (k = 2; GUM) and the standard uncertainties that it is made
of. "?": not known, and not in it. In brackets: not counted, since a larger one contains it."""
_SIGNALS = (
    ("rate_Hz", "samples per second", 1.0),
    ("clock_drift_ppm", "drift of the samples' clock [ppm]", 1.0),
    ("jitter_us", "jitter of the samples, RMS [µs]", 1.0),
    ("count_y_nm", "smallest step of y at rest [nm]; 0: none", 1.0),
    ("noise_y_counts", "noise of y at rest, RMS [counts]", 1.0),
    ("noise_x_counts", "noise of x at rest, RMS [counts]", 1.0),
    ("readback_gain", "readback of the current, relative to the command", 1.0),
    ("readback_offset_A", "its offset [mA]", 1e3),
)
_TIMING = {
    "as_measured_costs_um": "latencies as measured cost [µm p-p]",
    "p99_costs_um": "every command at the p99 would cost [µm p-p]",
    "longest_stall_survived_ms": "longest stall of the host that is survived [ms]",
    "amplifier_off_after_ms": "without commands the amplifier goes off after [ms]",
}


def certificate(work: Work) -> Outcome:
    """Write `certificate.html`, `certificate.json` and `tuned.yaml`, if every figure is within its limits; whether a
    required tolerance is kept, the certificate itself says."""
    folder, checks = work.folder, list(_checks(work))
    beyond = [one for one in checks if not one.passed]
    if beyond:
        names = "; ".join(map(str, beyond))
        steps = " and ".join(dict.fromkeys(f"--only {one.step}" for one in beyond))
        return Outcome(False, f"beyond the limits: {names}; when the cause is removed, repeat the step ({steps})")
    accepted, stage, described = work.outcomes["acceptance"].figures, work.stage, to_mapping(work.description)
    write_whole(folder / TUNED, as_parameter_file(work.described()))
    displayed = accepted["straightness"]
    straightness = _straightness(displayed)
    lacks = "its uncertainty is not known" if displayed else "the stroke is too short"
    passed, conclusion = _conclusion(straightness.get("after"), lacks, work.require)
    content = plain(
        {
            "passed": passed,
            "conclusion": conclusion,
            "stage": stage.name,
            "machine": "simulated" if work.machine.simulated else "real",
            "serial_number": stage.serial,
            "law": work.values["controller"].get("control.law"),
            "gains": {**work.outcomes["design"].gains, **work.outcomes["frequency_response"].gains},
            "required_um": work.require,
            "straightness": straightness,
            "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
            "made_by": origin(),
            "sha256": {
                name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in _files(work) if path.is_file()
            },
            "described": {name: value for name, value in described.items() if isinstance(value, float)},
            "current_path": _current_path(work),
            "map_noise_um": stage.uncertainty.map_noise * 1e6,
            "map_noise_by_runs": str(load_map(stage.guide).noise),
            "checks": [one._asdict() for one in checks],
            "later_limits": [
                {"name": name, "value": accepted[name], "limit": limit} for name, limit in accepted["limits"].items()
            ],
            "steps": {name: {"sentence": one.sentence, "figures": one.figures} for name, one in work.outcomes.items()},
        }
    )
    pictures = {"The loop, measured and modelled": folder / LOOP, "The stroke of the acceptance": folder / STROKE}
    write_whole(folder / FIGURES, json_text(content))
    write_whole(folder / PAGE, _page(content, pictures))
    return Outcome(passed, f"{conclusion}; {folder / PAGE}, {FIGURES} and {TUNED} are written")


def _straightness(displayed: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Before and after compensation: the direction with the larger value and uncertainty; what is not stated lacks."""
    found: dict[str, dict[str, Any]] = {}
    for one in displayed:
        if one["line"] != _LINE or one["expanded_uncertainty_um"] is None:
            continue
        upper = one["value_um"] + one["expanded_uncertainty_um"]
        if upper > found.get(one["when"], {}).get("upper_um", -1.0):
            kept = ("value_um", "expanded_uncertainty_um", "direction", "unknown")
            found[one["when"]] = {"upper_um": upper, **{name: one[name] for name in kept}}
    return found


def _conclusion(after: Mapping[str, Any] | None, lacks: str, require: float | None) -> tuple[bool, str]:
    """Whether the tolerance ``require`` in µm is kept, and the first sentence of the certificate; ``lacks`` says why
    there is no straightness ``after`` compensation."""
    if after is None:
        begin = "Passed without a tolerance" if require is None else "Not passed"
        return require is None, f"{begin}: the straightness is not stated, since {lacks}"
    stated = f"straightness after compensation {with_uncertainty(after['value_um'], after['expanded_uncertainty_um'])}"
    if require is None:
        return True, f"Passed: every figure is within its limits; {stated}; no tolerance was required (--require)"
    spare = require - after["upper_um"]
    begin, end = ("Passed", "to spare") if spare >= 0.0 else ("Not passed", "too much")
    return spare >= 0.0, f"{begin}: {stated}, required: at most {require:g} µm; {abs(spare):.2g} µm {end}"


def _files(work: Work) -> Iterator[tuple[str, Path]]:
    """What the certificate stands for: parameters, limits, map and bags; not what was learned, which production goes on
    learning."""
    for name in (TUNED, LIMITS):
        yield name, work.folder / name
    survey = find_survey(work.stage.guide.file)
    yield f"map {survey.name}", survey
    for bag in sorted((work.folder / "bags").rglob("*.mcap")):
        yield str(bag.relative_to(work.folder)), bag


def _current_path(work: Work) -> dict[str, dict[str, float]]:
    """Amplifier and delay as found, with the ranges for which the law is designed."""
    described, found, ranges = work.description.drive, work.stage.drive, work.stage.uncertainty
    us = work.stage.period * 1e6
    rows = (
        ("bandwidth of the amplifier [Hz]", "bandwidth", 1.0, 1.0 / ranges.amplifier, ranges.amplifier),
        ("delay of the commands [µs]", "delay", us, ranges.shortest_delay, ranges.longest_delay),
    )
    return {
        label: {
            "described": getattr(described, name) * unit,
            "found": (value := getattr(found, name) * unit),
            "low": value * low,
            "high": value * high,
        }
        for label, name, unit, low, high in rows
    }


def _checks(work: Work) -> Iterator[Check]:
    """Figures with what is allowed for each, and the step that found it."""
    outcomes = work.outcomes
    connection, margins = outcomes["connection"].figures, outcomes["frequency_response"].figures["margins"]
    yield limited("connection", "lost samples, amplifier off", connection["lost_samples"], "<=", 0.0)
    yield limited("connection", "samples without a command, amplifier off", connection["lost_commands"], "<=", 0.0)
    yield limited("frequency_response", "phase margin [°]", margins["phase_deg"], ">=", LEAST_PHASE)
    # A gain margin beyond the measured lines is larger than any that is demanded.
    if margins["gain_low"] is not None:
        yield limited("frequency_response", "least gain, factor", margins["gain_low"], "<=", 1.0 / LEAST_GAIN)
    if margins["gain_high"] is not None:
        yield limited("frequency_response", "largest gain, factor", margins["gain_high"], ">=", LEAST_GAIN)
    yield from stroke_checks(outcomes["acceptance"].figures, work.stage.encoder.y_resolution)


def _page(content: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """The page with the ``content`` of `certificate.json`, and the PNG files by their captions."""
    steps, sections = content["steps"], list[tuple[str, str]]()
    figures: dict[str, Mapping[str, Any]] = {name: one["figures"] for name, one in steps.items()}

    def section(title: str, *tables: tuple[Sequence[str], Sequence[Sequence[Any]]], note: str = "") -> None:
        """Headings and rows of each table; one without rows is left out."""
        shown = [blocks.table([dict(zip(head, row, strict=True)) for row in rows]) for head, rows in tables if rows]
        if note and shown:
            shown.insert(0, blocks.paragraph(note))
        sections.append((title, Markup("").join(shown)))

    connection, identification = figures["connection"], figures["identification"]
    measured = {**connection, **figures["signs_and_scales"]}
    section("The machine", (("", " "), _identity(content)))
    section("Summary", (("figure", "value", "allowed"), list(_summary(content))))
    found = [(name.replace("_", " "), blocks.list(_ideas(one["sentence"]))) for name, one in steps.items()]
    section("Findings", (("step", "finding"), found))
    checks = [tuple(one[key] for key in ("name", "value", "allowed", "passed")) for one in content["checks"]]
    section("Figures and their limits", (("figure", "measured", "allowed", ""), checks))
    if stated := worded(budget_rows(figures["acceptance"]["straightness"])):
        table = tuple(stated[0]), [tuple(one.values()) for one in stated]
        section("Straightness (ISO 230-1)", table, note=_STRAIGHTNESS)
    later = [(heading(one["name"]), one["value"], one["limit"]) for one in content["later_limits"]]
    section("Limits for later strokes", (("figure", "this stroke", "later strokes: at most"), later), note=_LATER)
    budget = [
        (one["cause"].replace("as described", "as found"), one["pp_um"], one["rms_um"])
        for one in figures["frequency_response"].get("design", figures["design"])["budget"]
    ]
    of_map = _BUDGET.format(content["map_noise_um"], content["map_noise_by_runs"])
    note = " ".join([*remarks([BudgetEntry(*one) for one in budget]), of_map])
    section("Where the error comes from", (("machine", "p-p [µm]", "RMS [µm]"), budget), note=note)
    section("What late commands cost", *_timing(figures["acceptance"]["timing"], connection["latency_histogram"]))
    signals = [(label, measured[name] * unit) for name, label, unit in _SIGNALS]
    section("Samples and readback", (("figure", "measured"), signals))
    section("The machine as found", *_machine(identification["parameters"], content))
    sections.append(("What the data cannot tell", blocks.list(identification["not_identifiable"])))
    margins = (figures["frequency_response"][name] for name in ("margins", "model_margins"))
    section("Margins", (("margin", "measured", "model"), margin_rows(*margins)))
    for caption, path in pictures.items():
        if path.is_file():
            sections.append((caption, blocks.picture(base64.b64encode(path.read_bytes()).decode(), caption)))
    digests = [(name, with_code(f"`{digest}`")) for name, digest in content["sha256"].items()]
    section("Files", (("file", "SHA-256"), digests))
    verdict = blocks.card(content["conclusion"], _whose(content), content["passed"])
    return html_page(
        content["stage"], f"Certificate of stage “{content['stage']}”", verdict, sections, with_plots=False
    )


def _whose(content: Mapping[str, Any]) -> str:
    """The machine of a certificate in one line."""
    serial = f", serial number {content['serial_number']}" if content["serial_number"] else ", no serial number given"
    kind = "Simulated machine: it says nothing of a real one" if content["machine"] == "simulated" else "Real machine"
    return f"{kind}. Stage “{content['stage']}”{serial}, law `{content['law']}`."


def _identity(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Rows that say what was certified, when and by what."""
    gains = {name.rpartition(".")[2]: value for name, value in content["gains"].items() if isinstance(value, float)}
    return [
        ("stage", content["stage"]),
        ("machine", content["machine"]),
        ("serial number", content["serial_number"] or with_code("not given (`stage.serial`)")),
        ("control law", content["law"]),
        ("gains", ", ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in gains.items())),
        ("commissioned", content["date"]),
        ("by", ", ".join(f"{name} {value}" for name, value in content["made_by"].items())),
    ]


def _summary(content: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """What a customer reads: figure, value and what is allowed."""
    required, stated = content["required_um"], content["straightness"]
    for when, one in stated.items():
        kept = f"≤ {required:g} µm" if when == "after" and required is not None else ""
        value = with_uncertainty(one["value_um"], one["expanded_uncertainty_um"])
        unknown = f"; without {', '.join(one['unknown'])}, which is not known" if one["unknown"] else ""
        yield f"straightness {when} compensation, minimum zone, {one['direction']}", f"{value} (k = 2){unknown}", kept
    figures = {name: one["figures"] for name, one in content["steps"].items()}
    margins, timing = figures["frequency_response"]["margins"], figures["acceptance"]["timing"]
    yield "phase margin", f"{margins['phase_deg']:.0f}°", f"≥ {LEAST_PHASE:g}°"
    for name, allowed in (("gain_low", f"≤ {1.0 / LEAST_GAIN:.2f}"), ("gain_high", f"≥ {LEAST_GAIN:.2f}")):
        value = margins[name]
        yield heading(name), "beyond what was measured" if value is None else f"{value:.2f}", allowed
    if latency := timing["latency_us"]:
        acts = f"acts after {timing['due_us']:.0f} µs"
        yield "latency of a command", f"{latency['p50']:.0f} µs, p99 {latency['p99']:.0f} µs", acts
    yield "longest stall of the host that is survived", f"{timing['longest_stall_survived_ms']} ms", ""


def _ideas(sentence: str) -> list[str]:
    """The parts of a step's finding, one idea each."""
    return [f"{one[:1].upper()}{one[1:]}." for one in sentence.rstrip(".").split("; ")]


_Tables = Iterator[tuple[Sequence[str], Sequence[Sequence[Any]]]]


def _timing(timing: Mapping[str, Any], histogram: Sequence[Sequence[float]]) -> _Tables:
    """JSON has no infinity: an error of a simulated stroke that is not there says that the platform is lost."""
    figures = {label: timing[name] for name, label in _TIMING.items() if name in timing}
    yield (
        ("figure", "value"),
        [
            ("the command acts after the sample [µs]", timing["due_us"]),
            *((f"latency {name} [µs]", value) for name, value in timing["latency_us"].items()),
            ("p-p with every command in time [µm]", timing["in_time_pp_um"]),
            *((label, "lost" if value is None else value) for label, value in figures.items()),
        ],
    )
    stalls = [(stall, "lost" if error is None else error) for stall, error in timing["stall_error_um"].items()]
    yield ("stall of the host", "largest error [µm]"), stalls
    most = max((count for _, count in histogram), default=1.0)
    bars = [(round(edge), round(count), blocks.bar(count / most)) for edge, count in histogram]
    yield ("latency up to [µs]", "commands", ""), bars


def _machine(parameters: Mapping[str, Mapping[str, Any]], content: Mapping[str, Any]) -> _Tables:
    def interval(one: Mapping[str, Any]) -> str:
        if one.get("known"):
            return "given, not found"
        return "hardly identifiable" if one.get("poor") else f"{one['low']:.4g} to {one['high']:.4g}"

    described = content["described"]
    words = {
        one.name: re.split("[,;]", one.description.rpartition(": ")[2])[0] + f" / {one.unit}" * bool(one.unit)
        for one in declarations(StageParameters)
    }
    words |= {name: f"{name.partition('.')[2].replace('_', ' ')} / ({unit})" for name, unit in DERIVED.items()}
    found = [(words[name], described.get(name, ""), one["value"], interval(one)) for name, one in parameters.items()]
    yield ("fact", "described", "found", "95 % interval"), found
    path = [(name, one["described"], one["found"], interval(one)) for name, one in content["current_path"].items()]
    yield ("current path", "described", "found", "range for which the law is designed"), path
