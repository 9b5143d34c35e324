"""What a bag says beside its samples: which bag of which stage, with which parameters, map and software."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from straightcomp_ros.analysis.evaluation import BagEvaluation
from straightcomp_ros.bags import MAP_ATTACHMENT
from straightcomp_ros.bags.folder import found_files, split_number
from straightcomp_ros.bags.information import ORIGIN_METADATA
from straightcomp_ros.bags.reader import read_attachments, read_metadata
from straightcomp_ros.fleet.history.strokes_of_bag import Recorded
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters

_IN_THE_LOOP = ("driver", "feedforward", "controller")
"""Nodes whose parameters have an effect on a stroke. The logger's name each bag's folder."""
_STAGE = "stage."
_LONGEST_NAME = 240
"""Bytes; file systems allow 255, of which `stage=` or `.html.part` take some."""


def recorded_facts(bag: Path, checksum: str, evaluation: BagEvaluation) -> Recorded:
    """The facts of a bag with this checksum, ``evaluation`` of the same bag; BagError when the bag is damaged."""
    attachments, reports, parameters = read_attachments(bag), evaluation.reports, evaluation.parameters
    origin = read_metadata(bag).get(ORIGIN_METADATA, {})
    facts = {
        name.removeprefix(_STAGE): value
        for name, value in parameters.get("driver", {}).items()
        if name.startswith(_STAGE)
    }
    own = {node: parameters[node] for node in _IN_THE_LOOP if node in parameters}
    survey = attachments.get(MAP_ATTACHMENT)
    return Recorded(
        checksum=checksum,
        bag=recorded_name(bag),
        stage=stored_name(str(facts.get("name") or "unknown")),
        identity=_identity(facts),
        parameters_checksum=checksum_of([json.dumps(own, sort_keys=True).encode()]) if own else None,
        map_checksum=None if survey is None else checksum_of([survey]),
        software_version=origin.get("version"),
        software_revision=origin.get("revision"),
        # The driver reports on the machine, the others on their computer.
        host=next((one.hardware_id for node in ("logger", "controller") for one in reports.get(node, ())), None),
    )


def stored_name(stage: str) -> str:
    """The name of a stage in a store, where it names a folder and files: the name itself, or where that is too long for
    a file system once it is quoted, its beginning with a checksum of all of it."""
    if len(quote(stage, safe="")) <= _LONGEST_NAME:
        return stage
    end = f"~{checksum_of([stage.encode('utf-8', 'backslashreplace')])[:12]}"
    kept = stage
    while len(quote(kept + end, safe="")) > _LONGEST_NAME:
        kept = kept[:-1]
    return kept + end


def recorded_name(bag: Path) -> str:
    """The name under which a bag was recorded, whatever its folder is called now."""
    return split_number(found_files(bag)[0][0])[0]


def checksum_of(parts: Iterable[bytes]) -> str:
    """BLAKE2b of these bytes, one after the other, 128 bits in hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


def _identity(facts: Mapping[str, Any]) -> str | None:
    try:
        return from_mapping(StageParameters, facts).identity if facts else None
    except ParameterError:
        # Recorded by a version with other facts.
        return None
