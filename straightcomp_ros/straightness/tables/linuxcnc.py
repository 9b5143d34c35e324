"""LinuxCNC's screw compensation file: a line ``nominal forward reverse`` for each point, and nothing else.

Read by ``usrmotLoadComp`` in LinuxCNC's ``src/emc/motion/usrmotintf.cc`` and named by ``COMP_FILE`` in a section
``[JOINT_n]`` of the INI file ("INI Configuration" in LinuxCNC's documentation). With ``COMP_FILE_TYPE = 0`` forward and
reverse are positions, with 1 they are trims = nominal − position, which LinuxCNC adds to the joint's command. Reading
stops at the first line without three numbers, so a comment would end the table; a joint holds 256 points. The unit is
that of the INI file.

LinuxCNC looks a joint's table up at the joint's own position. Moving Y by the position of X takes a HAL component that
reads this file and drives ``axis.y.eoffset-counts``.
"""

from pathlib import Path

from straightcomp_ros.straightness.tables.error_table import Conventions, ErrorTable, error_table
from straightcomp_ros.straightness.text import SurveyError, decimal, number, numbered_lines

_COLUMNS = ("nominal", "forward", "reverse")


def read(path: Path, conventions: Conventions) -> ErrorTable:
    """Read a file of either type; positions follow their nominal, trims stay near to zero.

    Raises:
        SurveyError: a line has not three numbers, or there are fewer than two points.
    """
    rows: list[list[float]] = []
    for line, text in numbered_lines(path):
        where = f"survey {path}, line {line}"
        cells = text.split()
        if len(cells) < len(_COLUMNS):
            raise SurveyError(f"{where}: {len(cells)} values; allowed: {', '.join(_COLUMNS)}")
        named = zip(_COLUMNS, cells, strict=False)
        rows.append([number(where, name, cell) / conventions.per_metre for name, cell in named])
    # Trims are small beside the travel, positions stay close to their nominal.
    trims = sum(abs(row[1]) for row in rows) < sum(abs(row[1] - row[0]) for row in rows)
    return error_table(
        f"survey {path}", [[x, *(-value if trims else value - x for value in values)] for x, *values in rows]
    )


def write(table: ErrorTable, conventions: Conventions) -> str:
    """A file for ``COMP_FILE_TYPE = 1``.

    Raises:
        SurveyError: more points than a joint holds.
    """
    table.check_size("LinuxCNC", 256)
    backward = table.forward if table.backward is None else table.backward
    return "".join(
        " ".join(decimal(value * conventions.per_metre, 7) for value in row) + "\n"
        for row in zip(table.x.tolist(), (-table.forward).tolist(), (-backward).tolist(), strict=True)
    )
