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

import re
from pathlib import Path

from straightcomp_ros.straightness.tables.error_table import Conventions, ErrorTable, error_table
from straightcomp_ros.straightness.text import SurveyError, decimal, number, numbered_lines

_PER_METRE = 1e7
_AXIS = "kopf.achs_nr"
_INDEX = re.compile(r"\[\s*0*(\d+)\s*\]")


def read(path: Path, conventions: Conventions) -> ErrorTable:
    """Read the list that corrects ``conventions.platform_axis`` over ``conventions.stage_axis``.

    Raises:
        SurveyError: it names other axes, the unit is encoder increments, or an entry is missing, given twice or no
            number.
    """
    where, prefix = f"survey {path}", "kw.crosscomp."
    entries: dict[str, float] = {}
    for line, text in numbered_lines(path, r"/\*.*?\*/|#.*"):
        cells = text.strip().rsplit(maxsplit=1)
        if len(cells) == 2 and (cells[0].startswith(prefix) or cells[0] == _AXIS):
            key = _INDEX.sub(r"[\1]", cells[0]).removeprefix(prefix)
            if key in entries:
                raise SurveyError(f"{where}, line {line}: {cells[0]} is given twice; allowed: once")
            entries[key] = number(f"{where}, line {line}", cells[0], cells[1])
    for key, name, wanted in (
        (_AXIS, "platform", conventions.platform_axis),
        ("master_ax_nr", "stage", conventions.stage_axis),
    ):
        if entries.get(key, wanted) != wanted:
            raise SurveyError(
                f"{where}: {key} {entries[key]:g}; allowed: {wanted}, the number of the {name}'s axis "
                f"(--{name}-axis {entries[key]:g} if that is it)"
            )
    if entries.get("unit") != 1.0:
        raise SurveyError(f"{where}: kw.crosscomp.unit {entries.get('unit', 0.0):g}; allowed: 1 (metric, in 0.1 µm)")
    points = []
    for index in range(int(entries.get("last_index", -1.0)) + 1):
        names = [f"table[{index}].{column}" for column in ("setpoint", "correction")]
        for name in names:
            if name not in entries:
                raise SurveyError(f"{where}: {prefix}{name} is missing; allowed: one for each")
        points.append([entries[names[0]] / _PER_METRE, -entries[names[1]] / _PER_METRE])
    return error_table(where, points)


def write(table: ErrorTable, conventions: Conventions) -> str:
    """A list for the platform's axis, which holds the mean of both directions.

    Raises:
        SurveyError: more points than a list holds.
    """
    table.check_size("crosscomp", 1001)
    lines = [
        f"{_AXIS} {conventions.platform_axis}",
        f"kw.crosscomp.last_index {len(table.x) - 1}",
        f"kw.crosscomp.master_ax_nr {conventions.stage_axis}",
        "kw.crosscomp.unit 1 /* metric, in 0.1 um */",
    ]
    for index, (x, value) in enumerate(zip(table.x.tolist(), (-table.mean).tolist(), strict=True)):
        lines.append(f"kw.crosscomp.table[{index}].setpoint {decimal(x * _PER_METRE, 3)}")
        lines.append(f"kw.crosscomp.table[{index}].correction {decimal(value * _PER_METRE, 3)}")
    return "\n".join(lines) + "\n"
