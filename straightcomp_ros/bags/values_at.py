"""Values of a recorded stream at given samples."""

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags.stream_columns import StreamColumns


def values_at(stream: StreamColumns | None, name: str, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Column ``name`` of ``stream`` at ``stamps`` (n,) in ns, (n,); NaN where it has none, or is not there.

    Of messages with the same stamp the first counts: lockstep repeats a sample that got no answer.
    """
    found = np.full(len(stamps), np.nan)
    if stream is not None:
        own, rows = np.unique(stream.stamp, return_index=True)
        places = np.minimum(np.searchsorted(own, stamps), max(0, len(own) - 1))
        there = own[places] == stamps if len(own) else np.zeros(len(stamps), dtype=bool)
        found[there] = stream.columns[name][rows[places[there]]]
    return found
