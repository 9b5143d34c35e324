"""Step `certificate`: one HTML file that prints well, the same as JSON, and the tuned parameters of all nodes."""

import base64
import datetime
import hashlib
import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from straightcomp_ros.bags.origin import origin
from straightcomp_ros.commissioning.outcome import Outcome, Work
from straightcomp_ros.configuration.parameter_file import as_parameter_file
from straightcomp_ros.settings.plain_json import plain
from straightcomp_ros.settings.whole_file import write_whole

TUNED, LOOP = "tuned.yaml", "loop.png"
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#111;max-width:900px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:1.6em}table{border-collapse:collapse;font-size:.9em}
td{padding:.15em 1em .15em 0;border-bottom:1px solid #ddd;vertical-align:top}td+td{font-variant-numeric:tabular-nums}
img{max-width:100%}.fail{color:#B00020;font-weight:600}@page{margin:16mm 14mm}
@media print{body{margin:0;padding:0;max-width:none;font-size:9pt}h2{break-after:avoid}tr,img{break-inside:avoid}}
"""


def certificate(work: Work) -> Outcome:
    """Write `certificate.html`, `certificate.json` and `tuned.yaml`."""
    folder = work.folder
    write_whole(folder / TUNED, as_parameter_file(work.described()))
    files = [folder / TUNED, folder / "limits.yaml", *sorted((folder / "bags").rglob("*.mcap"))]
    told = {
        "stage": work.stage.name,
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "made_by": origin(),
        "sha256": {str(path.relative_to(folder)): _checksum(path) for path in files if path.is_file()},
        "steps": {name: {"sentence": one.sentence, "figures": one.figures} for name, one in work.outcomes.items()},
    }
    write_whole(folder / "certificate.json", json.dumps(plain(told), indent=1, ensure_ascii=False) + "\n")
    write_whole(folder / "certificate.html", _page(told, folder / LOOP))
    return Outcome(True, f"{folder / 'certificate.html'}, certificate.json and {TUNED} are written")


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _page(told: Mapping[str, Any], loop: Path) -> str:
    sections = "".join(
        f"<h2>{escape(name.replace('_', ' '))}</h2><p>{escape(one['sentence'])}</p>{_table(one['figures'])}"
        for name, one in told["steps"].items()
    )
    picture = ""
    if loop.is_file():
        data = base64.b64encode(loop.read_bytes()).decode()
        picture = f"<h2>loop</h2><img alt='Bode and Nyquist plots' src='data:image/png;base64,{data}'>"
    name, date, package = map(escape, (told["stage"], told["date"], " ".join(told["made_by"].values())))
    return (
        f"<!DOCTYPE html><html lang=en><head><meta charset=utf-8><title>{name}</title><style>{_STYLE}</style></head>"
        f"<body><h1>Stage “{name}”</h1><p>Commissioned {date} with {package}</p>{sections}{picture}"
        f"<h2>files</h2>{_table(told['sha256'])}</body></html>\n"
    )


def _table(figures: Mapping[str, Any]) -> str:
    """Rows of all numbers and texts; those of inner mappings under both names. Lists are in the JSON alone."""
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in _flat(figures, ""))
    return f"<table>{rows}</table>" if rows else ""


def _flat(figures: Mapping[str, Any], before: str) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in figures.items():
        if isinstance(value, Mapping) and {"value", "low", "high"} <= set(value):
            given = "given" if value.get("known") else f"{value['low']:.4g} to {value['high']:.4g}"
            rows.append((before + name, f"{value['value']:.4g} ({given})"))
        elif isinstance(value, Mapping):
            rows += _flat(value, f"{before}{name} ")
        elif isinstance(value, float):
            rows.append((before + name, f"{value:.5g}"))
        elif not isinstance(value, list):
            rows.append((before + name, str(value)))
    return rows
