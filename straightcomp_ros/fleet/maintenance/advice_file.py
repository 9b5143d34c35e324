"""The file that carries a stage's advice to the live view and the OPC UA gateway: a small JSON file.

    {"stage": "gantry", "as_of": "2026-11-24", "advice": [{"cause": "guide", "text": "…", "remedy": "…", …}]}

`straightcomp history advise` writes it whole; who reads it finds the old file or the new one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

from straightcomp_ros.fleet.maintenance.advice import Advice
from straightcomp_ros.parameters.output_files import plain, write_whole


def advice_json(stage: str, as_of: date, advice: Sequence[Advice]) -> dict[str, Any]:
    """The content of the file: the advice that is due. ``as_of`` is the day of the last stroke that it knows."""
    return plain({"stage": stage, "as_of": str(as_of), "advice": [_entry(one) for one in advice if one.due]})  # type: ignore[no-any-return]


def write_advice(path: Path, content: dict[str, Any]) -> None:
    """Write :func:`advice_json`; OSError if that is impossible."""
    write_whole(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _entry(advice: Advice) -> dict[str, Any]:
    return {
        "cause": advice.cause,
        "text": advice.text,
        "remedy": advice.remedy,
        "since": str(advice.since),
        "found": str(advice.found),
        "from_mm": advice.place.first if advice.place else None,
        "to_mm": advice.place.last if advice.place else None,
        "figures": {change.figure: {"before": change.before, "after": change.after} for change in advice.changes},
    }
