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
        where = f"survey {path}, line {line}"
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
