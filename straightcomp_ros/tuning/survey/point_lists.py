"""Machine controllers' files that list points: position and correction, or position and error.

**LinuxCNC**'s screw compensation file (``.comp``): a line ``nominal forward reverse`` for each point, and nothing else.
Read by ``usrmotLoadComp`` in LinuxCNC's ``src/emc/motion/usrmotintf.cc`` and named by ``COMP_FILE`` in a section
``[JOINT_n]`` of the INI file ("INI Configuration" in LinuxCNC's documentation). With ``COMP_FILE_TYPE = 0`` forward and
reverse are positions, with 1 they are trims = nominal − position, which LinuxCNC adds to the joint's command. Reading
stops at the first line without three numbers, so a comment would end the table; a joint holds 256 points. The unit is
that of the INI file. LinuxCNC looks a joint's table up at the joint's own position. Moving Y by the position of X takes
a HAL component that reads this file and drives ``axis.y.eoffset-counts``.

**Cross compensation list** (``.lis``) of Beckhoff's TwinCAT CNC and of the ISG kernel that it contains:

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

**Etalon Exchange Format** (``.txt``) for the volumetric errors of machines, which several machine controllers read:

    // any comment
    [EYX]
    Gridpoints = {
      0.0  -0.003796
      10.0 -0.00312
    }

Described in ISG's and Beckhoff's documentation of volumetric compensation, "Etalon Exchange Format" (its variant
"Vendor") and "Units of measure": one block for each error in ISO 230-1's notation, positions and translational errors
in mm. EYX is the straightness error in Y of a motion along X, EZX the one in Z. Blocks of one value and of other errors
are skipped.
"""

import re
from pathlib import Path

from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.straightness.survey_table import decimal, number, numbered_lines
from straightcomp_ros.tuning.survey.error_table import Conventions, Points, survey_of

_LINUXCNC = ("nominal", "forward", "reverse")
_CROSSCOMP = 1e7
"""Counts in a metre."""
_ETALON = 1e3
_AXIS, _PREFIX = "kopf.achs_nr", "kw.crosscomp."
_INDEX = re.compile(r"\[\s*0*(\d+)\s*\]")


def read_linuxcnc(path: Path, conventions: Conventions) -> Survey:
    """Read a file of either type; positions follow their nominal, trims stay near to zero.

    Raises:
        SurveyError: a line has not three numbers, or there are fewer than two points.
    """
    rows: list[list[float]] = []
    for line, text in numbered_lines(path):
        where, cells = f"survey {path}, line {line}", text.split()
        if len(cells) < len(_LINUXCNC):
            raise SurveyError(f"{where}: {len(cells)} values; allowed: {', '.join(_LINUXCNC)}")
        named = zip(_LINUXCNC, cells, strict=False)
        rows.append([number(where, name, cell) / conventions.per_metre for name, cell in named])
    trims = sum(abs(row[1]) for row in rows) < sum(abs(row[1] - row[0]) for row in rows)
    return survey_of(f"survey {path}", ([x, *(-value if trims else value - x for value in both)] for x, *both in rows))


def write_linuxcnc(points: Points, conventions: Conventions) -> str:
    """A file for ``COMP_FILE_TYPE = 1``, with the same trim both ways where there is one deviation."""
    rows = ((x, -ways[0], -ways[-1]) for x, *ways in points)
    places = conventions.places(1e-10)
    return "".join(" ".join(decimal(value * conventions.per_metre, places) for value in row) + "\n" for row in rows)


def read_crosscomp(path: Path, conventions: Conventions) -> Survey:
    """Read the list that corrects ``conventions.platform_axis`` over ``conventions.stage_axis``.

    Raises:
        SurveyError: it names other axes, the unit is encoder increments, or an entry is missing, given twice or no
            number.
    """
    where, entries = f"survey {path}", dict[str, float]()
    for line, text in numbered_lines(path, r"/\*.*?\*/|#.*"):
        cells = text.rsplit(maxsplit=1)
        key = _INDEX.sub(r"[\1]", cells[0].strip()).removeprefix(_PREFIX) if cells else ""
        if len(cells) == 2 and (key == _AXIS or _PREFIX in cells[0]):
            if key in entries:
                raise SurveyError(f"{where}, line {line}: {key} is given twice; allowed: once")
            entries[key] = number(f"{where}, line {line}", key, cells[1])
    axes = ((_AXIS, "platform", conventions.platform_axis), ("master_ax_nr", "stage", conventions.stage_axis))
    for key, name, wanted in axes:
        if entries.get(key, wanted) != wanted:
            raise SurveyError(
                f"{where}: {key} {entries[key]:g}; allowed: {wanted}, the number of the {name}'s axis "
                f"(--{name}-axis {entries[key]:g} if that is it)"
            )
    if entries.get("unit") != 1.0:
        raise SurveyError(f"{where}: kw.crosscomp.unit {entries.get('unit', 0.0):g}; allowed: 1 (metric, in 0.1 µm)")
    points, last = [], entries.get("last_index", -1.0)
    for index in range(int(last) + 1):
        names = [f"table[{index}].{column}" for column in ("setpoint", "correction")]
        for name in names:
            if name not in entries:
                raise SurveyError(f"{where}: {_PREFIX}{name} is missing; allowed: one for each")
        points.append([entries[names[0]] / _CROSSCOMP, -entries[names[1]] / _CROSSCOMP])
    if last != (listed := sum(".setpoint" in key for key in entries) - 1):
        raise SurveyError(f"{where}: last_index {last:g}; allowed: {listed}, that of the last of its points")
    return survey_of(where, points)


def write_crosscomp(points: Points, conventions: Conventions) -> str:
    """A list for the platform's axis."""
    lines = [
        f"{_AXIS} {conventions.platform_axis}",
        f"{_PREFIX}last_index {len(points) - 1}",
        f"{_PREFIX}master_ax_nr {conventions.stage_axis}",
        f"{_PREFIX}unit 1 /* metric, in 0.1 um */",
    ]
    for index, (x, deviation) in enumerate(points):
        for column, value in (("setpoint", x), ("correction", -deviation)):
            lines.append(f"{_PREFIX}table[{index}].{column} {decimal(value * _CROSSCOMP, 3)}")
    return "\n".join(lines) + "\n"


def read_etalon(path: Path, conventions: Conventions) -> Survey:
    """Read the block of ``conventions.error``.

    Raises:
        SurveyError: no such block, or a line in it that is no pair of numbers.
    """
    blocks: dict[str, list[list[float]]] = {}
    name, inside = "", False
    for line, raw in numbered_lines(path, "//.*"):
        where, text = f"survey {path}, line {line}", raw.strip()
        heading = re.fullmatch(r"\[(\w+)\]", text)
        if heading:
            name, inside = heading[1].upper(), False
            continue
        opening = re.match(r"gridpoints\s*=", text, re.IGNORECASE)
        if opening:
            if name in blocks:
                raise SurveyError(f"{where}: the Gridpoints of [{name}] are given twice; allowed: once")
            blocks[name], inside, text = [], True, text[opening.end() :]
        if not inside or name != conventions.error:
            continue
        # Points may stand on the lines of the braces.
        text, brace, after = text.partition("}")
        cells = text.replace("{", " ").split()
        inside = not brace
        if len(cells) not in (0, 2) or after.strip():
            raise SurveyError(f"{where}: {raw.strip()!r}; allowed: a position and an error on each line")
        if cells:
            blocks[name].append([number(where, name, cell) / _ETALON for cell in cells])
    if inside and name == conventions.error:
        raise SurveyError(f"survey {path}: ends within the Gridpoints of [{name}]; is it cut off?")
    if conventions.error not in blocks:
        raise SurveyError(
            f"survey {path}: no Gridpoints of [{conventions.error}]; found: {', '.join(blocks) or 'none'}"
        )
    return survey_of(f"survey {path}, [{conventions.error}]", blocks[conventions.error])


def write_etalon(points: Points, conventions: Conventions) -> str:
    """A file with one block."""
    lines = [f"  {decimal(x * _ETALON, 7)} {decimal(value * _ETALON, 9)}" for x, value in points]
    return "\n".join([f"[{conventions.error}]", "Gridpoints = {", *lines, "}\n"])
