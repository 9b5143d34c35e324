"""Cross compensation list (``.lis``) of Beckhoff's TwinCAT CNC and of the ISG kernel that it contains.

    kopf.achs_nr                      2
    kw.crosscomp.last_index           1
    kw.crosscomp.master_ax_nr         1
    kw.crosscomp.unit                 1      /* 1: metric, in 0.1 µm */
    kw.crosscomp.table[0].setpoint    0
    kw.crosscomp.table[0].correction  37.96

Described in Beckhoff's documentation of TF5200 and TwinCAT CNC, "Axis compensation", parameters P-COMP-00001 to 00007,
and in ISG's of the kernel: it corrects the position of an axis by the command position of another one. Lengths
count 0.1 µm. Corrections may have decimals since version 3.1.3132; before, whole numbers. The list holds
1001 points unless P-COMP-00060 says otherwise.
"""

from __future__ import annotations

import re
from pathlib import Path

from straightcomp_ros.straightness.survey_columns import SurveyError
from straightcomp_ros.straightness.tables.error_table import Conventions, ErrorTable, error_table
from straightcomp_ros.straightness.text import decimal, number, read_text

_PER_METRE = 1e7
_ENTRY = re.compile(r"kw\.crosscomp\.table\[\s*(\d+)\s*\]\.(setpoint|correction)")
MOST_POINTS = 1001


def read(path: Path, conventions: Conventions) -> ErrorTable:
    """Read a list; ``conventions`` has nothing to add.

    Raises:
        SurveyError: the unit is encoder increments, or an entry is missing or no number.
    """
    plain: dict[str, float] = {}
    entries: dict[str, dict[int, float]] = {"setpoint": {}, "correction": {}}
    for line, raw in enumerate(read_text(path).splitlines(), start=1):
        cells = re.sub(r"/\*.*?\*/|#.*", "", raw).rsplit(maxsplit=1)
        if len(cells) != 2 or not cells[0].startswith("kw.crosscomp."):
            continue
        key, where = cells[0].strip(), f"survey {path}, line {line}"
        found = _ENTRY.fullmatch(key)
        if found:
            entries[found[2]][int(found[1])] = number(where, key, cells[1])
        else:
            plain[key.removeprefix("kw.crosscomp.")] = number(where, key, cells[1])
    where = f"survey {path}"
    if plain.get("unit") != 1.0:
        raise SurveyError(f"{where}: kw.crosscomp.unit {plain.get('unit', 0.0):g}; allowed: 1 (metric, in 0.1 µm)")
    points: list[tuple[float, float, float | None]] = []
    for index in range(int(plain.get("last_index", -1.0)) + 1):
        for column, values in entries.items():
            if index not in values:
                raise SurveyError(f"{where}: kw.crosscomp.table[{index}].{column} is missing; allowed: one for each")
        points.append((entries["setpoint"][index] / _PER_METRE, -entries["correction"][index] / _PER_METRE, None))
    return error_table(where, points)


def write(table: ErrorTable, conventions: Conventions) -> str:
    """A list for the platform's axis; the mean where both directions are known, since a list has but one value.

    Raises:
        SurveyError: more points than a list holds.
    """
    if len(table.x) > MOST_POINTS:
        raise SurveyError(f"{len(table.x)} points; allowed for crosscomp: <= {MOST_POINTS}: take a larger spacing")
    correction = -(table.forward if table.backward is None else 0.5 * (table.forward + table.backward))
    lines = [
        f"kopf.achs_nr {conventions.platform_axis}",
        f"kw.crosscomp.last_index {len(table.x) - 1}",
        f"kw.crosscomp.master_ax_nr {conventions.stage_axis}",
        "kw.crosscomp.unit 1 /* metric, in 0.1 um */",
    ]
    for index, (x, value) in enumerate(zip(table.x.tolist(), correction.tolist(), strict=True)):
        lines.append(f"kw.crosscomp.table[{index}].setpoint {decimal(x * _PER_METRE, 3)}")
        lines.append(f"kw.crosscomp.table[{index}].correction {decimal(value * _PER_METRE, 3)}")
    return "\n".join(lines) + "\n"
