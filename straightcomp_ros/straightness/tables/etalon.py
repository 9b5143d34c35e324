"""Etalon's exchange format, in which its LaserTRACER software hands measured axis errors to machine controllers.

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

from straightcomp_ros.straightness.tables.error_table import Conventions, ErrorTable, error_table
from straightcomp_ros.straightness.text import SurveyError, decimal, number, numbered_lines

_PER_METRE = 1e3


def read(path: Path, conventions: Conventions) -> ErrorTable:
    """Read the block of ``conventions.error``.

    Raises:
        SurveyError: no such block, or a line in it that is no pair of numbers.
    """
    blocks: dict[str, list[list[float]]] = {}
    name, inside = "", False
    for line, raw in numbered_lines(path, "//.*"):
        text = raw.strip()
        heading = re.fullmatch(r"\[(\w+)\]", text)
        if heading:
            name, inside = heading[1].upper(), False
        elif re.match(r"gridpoints\s*=", text, re.IGNORECASE):
            blocks[name], inside = [], True
        elif text.startswith("}"):
            inside = False
        elif inside and name == conventions.error and text.strip("{ "):
            where = f"survey {path}, line {line}"
            cells = text.split()
            if len(cells) != 2:
                raise SurveyError(f"{where}: {len(cells)} values; allowed: position and error")
            blocks[name].append([number(where, name, cell) / _PER_METRE for cell in cells])
    if conventions.error not in blocks:
        raise SurveyError(
            f"survey {path}: no Gridpoints of [{conventions.error}]; found: {', '.join(blocks) or 'none'}"
        )
    return error_table(f"survey {path}, [{conventions.error}]", blocks[conventions.error])


def write(table: ErrorTable, conventions: Conventions) -> str:
    """A file with one block, which holds the mean of both directions."""
    points = [
        f"  {decimal(x * _PER_METRE, 7)} {decimal(value * _PER_METRE, 9)}"
        for x, value in zip(table.x.tolist(), table.mean.tolist(), strict=True)
    ]
    return "\n".join([f"[{conventions.error}]", "Gridpoints = {", *points, "}\n"])
