"""Measurement files of the two common laser interferometers: Renishaw's ``.rtl`` and API's ``.pos``.

    TARGET DATA::                         Position      Bidirectional Avg Error
    Target-count:3                        0.0000        0.0001
    Targets :                             10.0000       -0.0004
      0.0000     10.0000     20.0000      Position      Forward Directional Avg Error
    Flags: …                              0.0000        0.0002
    RUNS::                                …
    Run-count:2                           Position      Reverse Directional Avg Error
    DEVIATIONS::                          …
    Run Target Data:
         1     1      0.3
         1     2     -0.1
    …

Renishaw: targets in mm, and for each reading the number of its run, of its target and the deviation in µm. API: blocks
of positions and mean errors, both in mm. Neither maker describes the files in public; this is what several public
programs read in them. Both are written for every linear measurement, and do not say that it was one of straightness.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from straightcomp_ros.straightness.survey import Survey, orient
from straightcomp_ros.straightness.survey_header import DIRECTIONS, WAYS, SurveyError
from straightcomp_ros.straightness.survey_table import number, numbered_lines
from straightcomp_ros.tuning.survey.error_table import Conventions, survey_of

_OTHER_KINDS = re.compile(
    r"angular|pitch|yaw|roll(?!ers?(?![a-z]))|rotary|flatness|squareness|dynamic|diagonal|velocity", re.IGNORECASE
)
_SAYS_THE_KIND = re.compile(
    r"(?!(?:machine|stage|controller)[\W_]*type|measurement[\W_]*location).*(?:type|measurement|mode(?!l))"
)
"""Of the names in a file: not those of the machine's own type and place."""
_BLOCK = re.compile(r"position\s+(bidirectional|forward|reverse|backward)[\w\s]*error.*", re.IGNORECASE)


def read_rtl(path: Path, conventions: Conventions) -> Survey:
    """Read Renishaw's file; each of its runs becomes one of the survey, in the direction of its targets.

    SurveyError if it is of another measurement, a number is missing or none, or a reading is given twice.
    """
    block = ""
    targets: list[float] = []
    readings: dict[int, dict[int, tuple[int, float, float]]] = {}
    counts: dict[str, float] = {}
    for line, raw in numbered_lines(path):
        where, text = f"survey {path}, line {line}", raw.strip()
        key, colon, value = (part.strip() for part in text.partition(":"))
        if text.endswith("::"):
            block = ""
        elif colon and not re.match(r"[+-]?[\d.]", text):
            block = name = key.lower()
            _refuse_other_kinds(where, name, value)
            if name in ("target-count", "run-count"):
                counts[name] = number(where, key, value)
        elif block == "targets":
            targets += [number(where, "target", cell) for cell in text.split()]
        elif block == "run target data":
            cells = _numbers(
                where, text, ("run", "target", "deviation"), "numbers of run and target, and the deviation in µm"
            )
            run, target = int(cells[0]), int(cells[1])
            if not 1 <= target <= len(targets) or [run, target] != cells[:2]:
                raise SurveyError(f"{where}: run {cells[0]:g}, target {cells[1]:g}; allowed: 1 to {len(targets)}")
            if target in readings.setdefault(run, {}):
                raise SurveyError(f"{where}: target {target} of run {run} is given twice; allowed: once")
            readings[run][target] = (line, targets[target - 1] * 1e-3, cells[2] * 1e-6)
    for name, there in (("target-count", len(targets)), ("run-count", len(readings))):
        if counts.get(name, there) != there:
            raise SurveyError(f"survey {path}: {name} says {counts[name]:g}, but the file has {there}; is it cut off?")
    for run, points in readings.items():
        if len(points) != len(targets):
            raise SurveyError(f"survey {path}: run {run} has {len(points)} of {len(targets)} targets; allowed: all")
    if not readings or len(targets) < 2:
        raise SurveyError(f"survey {path}: has no readings ('Run Target Data:'); is it Renishaw's .rtl file?")
    runs = (
        orient(f"survey {path}, run {run}", str(run), None, list(points.values())) for run, points in readings.items()
    )
    return Survey(tuple(runs), str(path))


def read_pos(path: Path, conventions: Conventions) -> Survey:
    """Read API's file: the mean errors forward and backward, or of both where it has no other.

    SurveyError if it is of another measurement, has no such block, one twice, or different positions in them.
    """
    blocks: dict[str, list[list[float]]] = {}
    block = ""
    for line, raw in numbered_lines(path):
        where, text = f"survey {path}, line {line}", raw.strip()
        heading = _BLOCK.fullmatch(text)
        if heading:
            block = heading[1].lower()
            block = DIRECTIONS.get(block, block)
            if block in blocks:
                raise SurveyError(f"{where}: the {block} errors are given twice; allowed: once")
            blocks[block] = []
        elif block and re.match(r"[+-]?[\d.]", text):
            cells = _numbers(where, text, ("position", "error"), "position and error in mm")
            blocks[block].append([cell * 1e-3 for cell in cells])
        else:
            block = ""
            key, _, value = text.partition(":")
            _refuse_other_kinds(where, key.strip().lower(), value)
    if not any(blocks.values()):
        raise SurveyError(f"survey {path}: has no block 'Position … Avg Error'; is it API's .pos file?")
    forward, backward = (sorted(blocks.get(way) or ()) for way in WAYS)
    if not forward or not backward:
        name = next(one for one in ("bidirectional", *WAYS) if blocks.get(one))
        return survey_of(f"survey {path}, {name}", blocks[name], (DIRECTIONS.get(name, "forward"),))
    positions, ours = [x for x, _ in forward], [x for x, _ in backward]
    if len(positions) != len(ours) or not np.allclose(positions, ours, rtol=0.0, atol=1e-7):
        raise SurveyError(f"survey {path}: the positions forward and backward differ; allowed: the same")
    return survey_of(f"survey {path}", ([*there, back] for there, (_, back) in zip(forward, backward, strict=True)))


def _refuse_other_kinds(where: str, name: str, value: str) -> None:
    if _SAYS_THE_KIND.match(name) and _OTHER_KINDS.search(value):
        raise SurveyError(f"{where}: the measurement is {value.strip()!r}; allowed: one of straightness")


def _numbers(where: str, text: str, names: Sequence[str], allowed: str) -> list[float]:
    cells = text.split()
    found = [number(where, name, cell) for name, cell in zip(names, cells, strict=False)]
    if len(cells) != len(names):
        raise SurveyError(f"{where}: {text!r}; allowed: {allowed}")
    return found
