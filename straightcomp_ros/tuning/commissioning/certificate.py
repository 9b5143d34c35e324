"""Step `certificate`: one HTML file that prints well, the same as JSON, and the tuned parameters of all nodes."""

import datetime
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from straightcomp_ros.bags.information import origin
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.output_files import plain, write_whole
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.tuning.commissioning import FIGURES, LEARNED, LIMITS, LOOP, PAGE, STROKE, TUNED
from straightcomp_ros.tuning.commissioning.acceptance import Check, at_least, at_most, stroke_checks
from straightcomp_ros.tuning.commissioning.certificate_page import certificate_page
from straightcomp_ros.tuning.commissioning.closed_loop import LEAST_GAIN, LEAST_PHASE
from straightcomp_ros.tuning.commissioning.step import Outcome, Work


def certificate(work: Work) -> Outcome:
    """Write `certificate.html`, `certificate.json` and `tuned.yaml`, if every figure is within its limits."""
    folder, checks = work.folder, list(_checks(work))
    beyond = [one for one in checks if not one.passed]
    if beyond:
        names = "; ".join(map(str, beyond))
        steps = " and ".join(dict.fromkeys(f"--only {one.step}" for one in beyond))
        return Outcome(False, f"beyond the limits: {names}; when the cause is removed, repeat the step ({steps})")
    accepted = work.outcomes["acceptance"].figures
    write_whole(folder / TUNED, as_parameter_file(work.described()))
    content = plain(
        {
            "stage": work.stage.name,
            "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
            "made_by": origin(),
            "sha256": {
                name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in _files(work) if path.is_file()
            },
            "described": {
                name: value for name, value in to_mapping(work.description).items() if isinstance(value, float)
            },
            "current_path": _current_path(work),
            "map_noise_um": work.stage.uncertainty.map_noise * 1e6,
            "checks": [one._asdict() for one in checks],
            "later_limits": [
                {"name": name, "value": accepted[name], "limit": limit} for name, limit in accepted["limits"].items()
            ],
            "steps": {name: {"sentence": one.sentence, "figures": one.figures} for name, one in work.outcomes.items()},
        }
    )
    pictures = {"The loop, measured and modelled": folder / LOOP, "The stroke of the acceptance": folder / STROKE}
    write_whole(folder / FIGURES, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    write_whole(folder / PAGE, certificate_page(content, pictures))
    return Outcome(True, f"{folder / PAGE}, {FIGURES} and {TUNED} are written")


def _files(work: Work) -> Iterator[tuple[str, Path]]:
    """What the certificate stands for: parameters, limits, map and bags."""
    for name in (TUNED, LIMITS, LEARNED):
        yield name, work.folder / name
    survey = Path(work.stage.guide.file)
    yield f"map {survey.name}", survey
    for bag in sorted((work.folder / "bags").rglob("*.mcap")):
        yield str(bag.relative_to(work.folder)), bag


def _current_path(work: Work) -> dict[str, dict[str, float]]:
    """Amplifier and delay as found, with the ranges for which the law is designed."""
    described, found, ranges = work.description.drive, work.stage.drive, work.stage.uncertainty
    us = work.stage.period * 1e6

    def ranged(described: float, found: float, low: float, high: float) -> dict[str, float]:
        return {"described": described, "found": found, "low": found * low, "high": found * high}

    return {
        "bandwidth of the amplifier [Hz]": ranged(
            described.bandwidth, found.bandwidth, 1.0 / ranges.amplifier, ranges.amplifier
        ),
        "delay of the commands [µs]": ranged(
            described.delay * us, found.delay * us, ranges.shortest_delay, ranges.longest_delay
        ),
    }


def _checks(work: Work) -> Iterator[Check]:
    """Figures with what is allowed for each, and the step that found it."""
    outcomes = work.outcomes
    connection, margins = outcomes["connection"].figures, outcomes["frequency_response"].figures["margins"]
    yield at_most("connection", "lost samples, amplifier off", connection.get("lost_samples"), 0.0)
    yield at_most("connection", "samples without a command, amplifier off", connection.get("lost_commands"), 0.0)
    yield at_least("frequency_response", "phase margin [°]", margins["phase_deg"], LEAST_PHASE)
    # A gain margin beyond the measured lines is larger than any that is demanded.
    if margins["gain_low"] is not None:
        yield at_most("frequency_response", "least gain, factor", margins["gain_low"], 1.0 / LEAST_GAIN)
    if margins["gain_high"] is not None:
        yield at_least("frequency_response", "largest gain, factor", margins["gain_high"], LEAST_GAIN)
    yield from stroke_checks(outcomes["acceptance"].figures, work.stage.encoder.y_resolution)
