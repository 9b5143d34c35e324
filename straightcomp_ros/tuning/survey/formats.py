"""All formats by name."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.straightness.survey import Survey, SurveyError
from straightcomp_ros.tuning.survey import aerotech, laser, point_lists
from straightcomp_ros.tuning.survey.error_table import Conventions, ErrorTable


class Format(NamedTuple):
    """The ending of a format's files, and its functions, which raise SurveyError; an instrument's is only read."""

    ending: str
    read: Callable[[Path, Conventions], ErrorTable | Survey]
    write: Callable[[ErrorTable, Conventions], str] | None = None


FORMATS = {
    "aerotech": Format(".cal", aerotech.read, aerotech.write),
    "crosscomp": Format(".lis", point_lists.read_crosscomp, point_lists.write_crosscomp),
    "etalon": Format(".txt", point_lists.read_etalon, point_lists.write_etalon),
    "linuxcnc": Format(".comp", point_lists.read_linuxcnc, point_lists.write_linuxcnc),
    "renishaw": Format(".rtl", laser.read_rtl),
    "api": Format(".pos", laser.read_pos),
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
