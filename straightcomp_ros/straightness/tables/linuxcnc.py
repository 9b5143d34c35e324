"""LinuxCNC's screw compensation file: a line ``nominal forward reverse`` for each point, and nothing else.

Read by ``usrmotLoadComp`` in LinuxCNC's ``src/emc/motion/usrmotintf.cc`` and named by ``COMP_FILE`` in a section
``[JOINT_n]`` of the INI file ("INI Configuration" in LinuxCNC's documentation). With ``COMP_FILE_TYPE = 0`` forward and
reverse are positions, with 1 they are trims = nominal − position, which LinuxCNC adds to the joint's command. Reading
stops at the first line without three numbers, so a comment would end the table; a joint holds 256 points. The unit is
that of the INI file.

LinuxCNC looks a joint's table up at the joint's own position. Moving Y by the position of X takes a HAL component that
reads this file and drives ``axis.y.eoffset-counts``.
"""

from __future__ import annotations

from pathlib import Path

from straightcomp_ros.straightness.survey_columns import SurveyError
from straightcomp_ros.straightness.tables.error_table import Conventions, ErrorTable, error_table
from straightcomp_ros.straightness.text import decimal, number, read_text

MOST_POINTS = 256


def read(path: Path, conventions: Conventions) -> ErrorTable:
    """Read a file of either type; positions follow their nominal, trims stay near to zero.

    Raises:
        SurveyError: a line has not three numbers, or there is no point.
    """
    rows: list[tuple[float, float, float]] = []
    for line, text in enumerate(read_text(path).splitlines(), start=1):
        if not text.strip():
            continue
        where = f"survey {path}, line {line}"
        cells = text.split()
        if len(cells) < 3:
            raise SurveyError(f"{where}: {len(cells)} values; allowed: nominal, forward, reverse")
        nominal, forward, reverse = (
            number(where, name, cell) / conventions.per_metre
            for name, cell in zip(("nominal", "forward", "reverse"), cells[:3], strict=True)
        )
        rows.append((nominal, forward, reverse))
    # Trims are small beside the travel, positions stay close to their nominal.
    if sum(abs(row[1]) for row in rows) < sum(abs(row[1] - row[0]) for row in rows):
        points = [(nominal, -forward, -reverse) for nominal, forward, reverse in rows]
    else:
        points = [(nominal, forward - nominal, reverse - nominal) for nominal, forward, reverse in rows]
    return error_table(f"survey {path}", [(x, forward, backward) for x, forward, backward in points])


def write(table: ErrorTable, conventions: Conventions) -> str:
    """A file for ``COMP_FILE_TYPE = 1``.

    Raises:
        SurveyError: more points than a joint holds.
    """
    if len(table.x) > MOST_POINTS:
        raise SurveyError(f"{len(table.x)} points; allowed for LinuxCNC: <= {MOST_POINTS}: take a larger spacing")
    backward = table.forward if table.backward is None else table.backward
    lines = [
        " ".join(decimal(value * conventions.per_metre, 7) for value in (x, -forward, -reverse))
        for x, forward, reverse in zip(table.x.tolist(), table.forward.tolist(), backward.tolist(), strict=True)
    ]
    return "\n".join(lines) + "\n"
