"""Bytes of a message that mean nothing: CDR's alignment gaps, which other writers fill with whatever was in memory."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags.definitions import typestore
from straightcomp_ros.messages.cdr import Layout

ENCAPSULATION_SIZE = 4
_STAMP_SIZE = 8


def constant_places(layout: Layout) -> list[tuple[int, int]]:
    """(first, end) byte of the encapsulation and of each run of constants in a message."""
    places, place = [(0, ENCAPSULATION_SIZE)], ENCAPSULATION_SIZE + _STAMP_SIZE
    for constant, run in zip(layout.constants, layout.runs, strict=True):
        places.append((place, place + len(constant)))
        place += len(constant) + 8 * run
    return places


@cache
def meaningful(layout: Layout) -> NDArray[np.bool_]:
    """For each byte of a message, True where it is constant and a decoder looks at it.

    Found by trial: a byte means nothing when the message decodes to the same with any other byte in its place.
    """
    template = layout.pack(0, *(0.0 for _ in layout.columns))
    expected = _decoded(template, layout)
    mask = np.zeros(layout.size, np.bool_)
    for first, end in constant_places(layout):
        mask[first:end] = True
    for place in np.flatnonzero(mask)[ENCAPSULATION_SIZE:]:
        # Gaps are zero in a layout's constants; anything else is a letter or a number.
        if template[place] == 0:
            changed = bytearray(template)
            changed[place] = 0xFF
            mask[place] = _decoded(bytes(changed), layout) != expected
    mask.setflags(write=False)
    return mask


def _decoded(message: bytes, layout: Layout) -> str:
    try:
        return repr(typestore().deserialize_cdr(message, layout.type_name))
    except Exception as error:  # Whatever the decoder stumbles over: the byte meant something.
        return repr(error)
