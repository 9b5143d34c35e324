"""Step `certificate`: one HTML file that prints well, the same as JSON, and the tuned parameters of all nodes."""

import datetime
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from straightcomp_ros.bags.origin import origin
from straightcomp_ros.commissioning.certificate_page import certificate_page
from straightcomp_ros.commissioning.outcome import Outcome, Work
from straightcomp_ros.configuration.parameter_file import as_parameter_file
from straightcomp_ros.settings.declaration import to_mapping
from straightcomp_ros.settings.plain_json import plain
from straightcomp_ros.settings.whole_file import write_whole

TUNED, LOOP, STROKE, LEARNED = "tuned.yaml", "loop.png", "stroke.png", "learned.csv"
LEAST_PHASE, LEAST_GAIN = 10.0, 1.3
"""Smallest phase margin in degrees and gain margin that `frequency_response` accepts."""


def certificate(work: Work) -> Outcome:
    """Write `certificate.html`, `certificate.json` and `tuned.yaml`."""
    folder = work.folder
    write_whole(folder / TUNED, as_parameter_file(work.described()))
    told = plain(
        {
            "stage": work.stage.name,
            "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
            "made_by": origin(),
            "sha256": {name: _checksum(path) for name, path in _files(work) if path.is_file()},
            "described": {
                name: value for name, value in to_mapping(work.description).items() if isinstance(value, float)
            },
            "checks": list(_checks(work)),
            "steps": {name: {"sentence": one.sentence, "figures": one.figures} for name, one in work.outcomes.items()},
        }
    )
    pictures = {"The loop, measured and modelled": folder / LOOP, "The stroke of the acceptance": folder / STROKE}
    write_whole(folder / "certificate.json", json.dumps(told, indent=1, ensure_ascii=False) + "\n")
    write_whole(folder / "certificate.html", certificate_page(told, pictures))
    return Outcome(True, f"{folder / 'certificate.html'}, certificate.json and {TUNED} are written")


def _files(work: Work) -> Iterator[tuple[str, Path]]:
    """What the certificate stands for: parameters, limits, map and bags."""
    for name in (TUNED, "limits.yaml", LEARNED):
        yield name, work.folder / name
    survey = Path(work.stage.guide.file)
    yield f"map {survey.name}", survey
    for bag in sorted((work.folder / "bags").rglob("*.mcap")):
        yield str(bag.relative_to(work.folder)), bag


def _due_us(work: Work) -> float:
    """How long after its sample a command acts, µs."""
    return round(work.stage.drive.delay * work.stage.period * 1e6, 1)


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _checks(work: Work) -> Iterator[dict[str, Any]]:
    """Figures with what is allowed for each."""

    def check(name: str, value: float | None, low: float | None = None, high: float | None = None) -> dict[str, Any]:
        allowed = f">= {low:g}" if low is not None else f"<= {high:g}"
        within = value is not None and (low is None or value >= low) and (high is None or value <= high)
        return {"name": name, "value": value, "allowed": allowed, "passed": within}

    outcomes = work.outcomes
    connection, accepted = outcomes["connection"].figures, outcomes["acceptance"].figures
    response = outcomes["frequency_response"].figures
    yield check("lost samples", connection["lost_samples"], high=0.0)
    if connection["latency_us"]:
        yield check("latency p99 [µs]", connection["latency_us"]["p99"], high=_due_us(work))
    margins = response["margins"]
    # A margin beyond the measured lines is larger than any that is demanded.
    if margins["phase_deg"] is not None:
        yield check("phase margin [°]", margins["phase_deg"], low=LEAST_PHASE)
    if margins["gain_high"] is not None:
        yield check("gain margin, factor", margins["gain_high"], low=LEAST_GAIN)
    for name, limit in accepted["limits"].items():
        yield check(name, accepted[name], high=limit)
