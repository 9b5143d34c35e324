"""All formats by name."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.straightness.tables import aerotech, crosscomp, etalon, linuxcnc
from straightcomp_ros.straightness.tables.error_table import Conventions, ErrorTable
from straightcomp_ros.straightness.text import SurveyError


class Format(NamedTuple):
    """The ending of a format's files, by which it is recognised, and its functions; both raise SurveyError."""

    ending: str
    read: Callable[[Path, Conventions], ErrorTable]
    write: Callable[[ErrorTable, Conventions], str]


FORMATS = {
    "aerotech": Format(".cal", aerotech.read, aerotech.write),
    "crosscomp": Format(".lis", crosscomp.read, crosscomp.write),
    "etalon": Format(".txt", etalon.read, etalon.write),
    "linuxcnc": Format(".comp", linuxcnc.read, linuxcnc.write),
}


def format_of(path: Path, name: str | None) -> Format:
    """The format ``name``, or without a name the one with the file's ending.

    Raises:
        SurveyError: the ending is of none.
    """
    if name is not None:
        return FORMATS[name]
    for one in FORMATS.values():
        if path.suffix.lower() == one.ending:
            return one
    known = ", ".join(f"{one.ending} ({name})" for name, one in FORMATS.items())
    raise SurveyError(f"{path}: the ending {path.suffix!r} tells no format; allowed: {known}, or name it with --format")
