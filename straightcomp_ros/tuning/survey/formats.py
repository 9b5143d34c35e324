"""All formats by name."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.tuning.survey import aerotech, laser, point_lists
from straightcomp_ros.tuning.survey.error_table import Conventions, Points


class Format(NamedTuple):
    """The ending of a format's files, its functions, which raise SurveyError, the most points that a controller holds,
    and whether it has a table for each direction; an instrument's format is only read."""

    ending: str
    read: Callable[[Path, Conventions], Survey]
    write: Callable[[Points, Conventions], str] | None = None
    most: int | None = None
    directed: bool = False


FORMATS = {
    "aerotech": Format(".cal", aerotech.read, aerotech.write),
    "crosscomp": Format(".lis", point_lists.read_crosscomp, point_lists.write_crosscomp, 1001),
    "etalon": Format(".txt", point_lists.read_etalon, point_lists.write_etalon),
    "linuxcnc": Format(".comp", point_lists.read_linuxcnc, point_lists.write_linuxcnc, 256, directed=True),
    "renishaw": Format(".rtl", laser.read_rtl),
    "api": Format(".pos", laser.read_pos),
}
WRITTEN = {name: one.write for name, one in FORMATS.items() if one.write is not None}


def format_of(path: Path, name: str | None) -> str:
    """The format ``name``, or without a name the one with the file's ending; SurveyError if that is of none."""
    found = name or next((name for name, one in FORMATS.items() if path.suffix.lower() == one.ending), None)
    if found is None:
        known = ", ".join(f"{one.ending} ({name})" for name, one in FORMATS.items())
        raise SurveyError(f"{path}: the ending {path.suffix!r} names no format; allowed: {known}, or --format NAME")
    return found


def written(name: str, points: Points, conventions: Conventions) -> str:
    """The text of a file of the format ``name``, one of :data:`WRITTEN`; of deviations forward and backward their mean
    where it has one table for both. SurveyError for too many points."""
    write, most = WRITTEN[name], FORMATS[name].most
    if not FORMATS[name].directed:
        points = [(x, sum(deviations) / len(deviations)) for x, *deviations in points]
    if most is not None and len(points) > most:
        raise SurveyError(f"{len(points)} points; allowed for {name}: <= {most}: take a larger spacing")
    return write(points, conventions)
