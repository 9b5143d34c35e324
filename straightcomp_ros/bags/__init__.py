"""Bags: rosbag2 folders with MCAP files, written and read without ROS."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import RLock

from straightcomp_ros.parameters.declaration import parameter


class BagError(ValueError):
    """A bag cannot be written or read; the text names the file, what is wrong and what to do."""

    damage = ""
    """What is damaged, without the file and the advice."""


class NoBag(BagError):
    """What is named as a bag is none, or no new one can be begun there: the text says what is there."""


WARNINGS = RLock()
"""Whoever changes how warnings are shown holds it: Python has that once for all threads of a process."""


@contextmanager
def noting_warnings() -> Iterator[list[str]]:
    """Keep the readers' warnings of the block from the terminal; at its end the list has each different text once."""
    texts: list[str] = []
    with WARNINGS, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield texts
    for one in caught:
        if not issubclass(one.category, UserWarning):
            # A library's, about code.
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
        elif str(one.message) not in texts:
            texts.append(str(one.message))


PARAMETERS_ATTACHMENT = "parameters.yaml"
"""Name of a bag's attachment with the parameters of the recorded nodes, as a ROS 2 parameter file."""
MAP_ATTACHMENT = "map.csv"
"""Name of a bag's attachment with the survey that the reference was made from."""
BAND_ATTACHMENT = "map_band.csv"
"""Name of a bag's attachment with the map itself and the standard deviation that the survey's noise leaves in it."""


@dataclass(frozen=True)
class RecorderParameters:
    """How bags are written."""

    output: str = parameter("", "Folder of the bag; empty: a new one, named after the start time")
    compression: str = parameter("zstd", "Compression of the bag's chunks", choices=("zstd", "lz4", "none"))
    queue_limit: int = parameter(
        200_000, "Messages that may wait in memory for the disk; further ones are dropped and counted", "[1000, inf)"
    )
    max_file_bytes: int = parameter(
        0, "Size of a file at which the bag continues in a new one; 0 for one file", "[0, inf) byte"
    )
    max_file_duration: float = parameter(
        0.0,
        "Time from a file's first message after which the bag continues in a new file; 0 for one file",
        "[0, inf) s",
    )
    snapshot: float = parameter(
        0.0,
        "Length of the recording that stays in memory until the service ~/snapshot or an incident writes it; 0 writes "
        "all at once",
        "[0, 600] s",
    )
    min_free_bytes: int = parameter(
        200_000_000, "Free bytes on the disk below which the logger finishes the bag and fails", "[0, inf) byte"
    )
    sync_interval: float = parameter(
        0.2,
        "Time from one sync of the recording to the disk to the next, which a power cut may cost with some tenths of a "
        "second more; 0: when the system does it by itself",
        "[0, 60] s",
    )
