"""All formats by name."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.straightness.survey import Survey, SurveyError
from straightcomp_ros.straightness.tables import aerotech, laser, point_lists
from straightcomp_ros.straightness.tables.error_table import Conventions, ErrorTable


class Format(NamedTuple):
    """The ending of a format's files, what their text has, and the functions of the format, which raise SurveyError;
    nothing is written in that of an instrument."""

    ending: str
    mark: str
    read: Callable[[Path, Conventions], ErrorTable | Survey]
    write: Callable[[ErrorTable, Conventions], str] | None = None


FORMATS = {
    "aerotech": Format(".cal", r":START2?D?\b", aerotech.read, aerotech.write),
    "crosscomp": Format(".lis", r"kw\.crosscomp\.", point_lists.read_crosscomp, point_lists.write_crosscomp),
    "etalon": Format(".txt", r"(?i)gridpoints\s*=", point_lists.read_etalon, point_lists.write_etalon),
    "linuxcnc": Format(".comp", r"\A(?:\s*[-+]?[\d.]+){3}\s*$", point_lists.read_linuxcnc, point_lists.write_linuxcnc),
    "renishaw": Format(".rtl", r"(?i)run target data\s*:", laser.read_rtl),
    "api": Format(".pos", r"(?i)position\s+\w+[\w\s]*avg error", laser.read_pos),
}
WRITTEN = {name: one.write for name, one in FORMATS.items() if one.write is not None}
"""What writes an error table, by format."""


def format_of(path: Path, name: str | None) -> Format:
    """The format ``name``, or without a name the one with the file's ending; SurveyError if that is of none."""
    if name is not None:
        return FORMATS[name]
    for one in FORMATS.values():
        if path.suffix.lower() == one.ending:
            return one
    known = ", ".join(f"{one.ending} ({name})" for name, one in FORMATS.items())
    raise SurveyError(f"{path}: the ending {path.suffix!r} tells no format; allowed: {known}, or name it with --format")


def recognised(path: Path) -> str | None:
    """Name of the format that a file's text has, whatever its ending; None if it has that of none."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    return next((name for name, one in FORMATS.items() if re.search(one.mark, text, re.MULTILINE)), None)
