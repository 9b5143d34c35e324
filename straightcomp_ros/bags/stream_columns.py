"""The messages of one stream as columns: whole blocks through a layout, odd messages one by one through rosbags."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.definitions import typestore
from straightcomp_ros.bags.mcap_records import FRAME, HEAD, rows
from straightcomp_ros.bags.messages import decoded
from straightcomp_ros.messages.cdr import ENCAPSULATION, NANOSECONDS, Layout, LayoutMismatch, read_by_names


@dataclass(frozen=True)
class StreamColumns:
    """Messages of one topic, in the order in which they were recorded.

    Attributes:
        log_time, publish_time, stamp: (n,) int64, when each was received, when its source made it, and the stamp of its
            header, ns since the epoch.
        columns: (n,) float64 for each column of the layout, in the units of the stream.
    """

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    stamp: NDArray[np.int64]
    columns: dict[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.stamp)


class StreamDecoder:
    """Gathers the messages of one topic, which should have ``layout``; ``topic`` names it, and the bag, in errors."""

    def __init__(self, topic: str, layout: Layout) -> None:
        self._topic, self._layout, self._dtype = topic, layout, layout.dtype
        self._template = np.frombuffer(layout.pack(0, *(0.0 for _ in layout.columns)), np.uint8)
        self._constants = constant_places(layout)
        self._batches: list[tuple[NDArray[Any], ...]] = []

    def add(self, data: bytes, places: NDArray[np.int64]) -> None:
        """Decode the message records at ``places`` in ``data``. Raises BagError when a message is neither of the layout
        nor decodes to its joints and arrays."""
        heads = rows(data, places, HEAD)
        lengths = heads["length"].astype(np.int64)
        stamp = np.empty(len(places), np.int64)
        numbers = np.empty((len(self._layout.columns), len(places)))
        fits = lengths >= HEAD.itemsize - FRAME.size + self._layout.size
        messages = rows(data, places[fits] + HEAD.itemsize, self._dtype)
        same = self._same_constants(messages)
        fits[fits] = same
        if not same.all():
            messages = messages[same]
        stamp[fits] = messages["sec"].astype(np.int64) * NANOSECONDS + messages["nanosec"]
        for column, name in zip(numbers, self._layout.columns, strict=True):
            column[fits] = messages[name]
        for odd in np.flatnonzero(~fits):
            message = data[places[odd] + HEAD.itemsize : places[odd] + FRAME.size + lengths[odd]]
            stamp[odd], numbers[:, odd] = self._by_names(message, int(odd))
        log_time, publish_time = heads["log_time"].astype(np.int64), heads["publish_time"].astype(np.int64)
        self._batches.append((log_time, publish_time, stamp, *numbers))

    def finished(self) -> StreamColumns | None:
        """All messages so far; None when there was none."""
        if not self._batches:
            return None
        log_time, publish_time, stamp, *numbers = map(np.concatenate, zip(*self._batches, strict=True))
        return StreamColumns(log_time, publish_time, stamp, dict(zip(self._layout.columns, numbers, strict=True)))

    def _same_constants(self, messages: NDArray[np.void]) -> NDArray[np.bool_]:
        content = messages.view(np.uint8).reshape(len(messages), self._layout.size)
        template = self._template
        # One comparison of memory for the whole block; message by message only where it fails.
        if all(
            content[:, first:end].tobytes() == template[first:end].tobytes() * len(messages)
            for first, end in self._constants
        ):
            return np.ones(len(messages), np.bool_)
        mask = meaningful(self._layout)
        return np.asarray((content[:, mask] == template[mask]).all(axis=1), np.bool_)

    def _by_names(self, message: bytes, place: int) -> tuple[int, list[float]]:
        number, type_name = sum(len(stamp) for _, _, stamp, *_ in self._batches) + place, self._layout.type_name
        where = f"{self._topic}: message {number}"
        try:
            return read_by_names(self._layout, decoded(where, message, type_name))
        except LayoutMismatch as error:
            allowed = f"allowed is a {type_name} with {', '.join(self._layout.columns)}"
            raise BagError(f"{where} lacks {error}; {allowed}") from error


def constant_places(layout: Layout) -> list[tuple[int, int]]:
    """(first, end) byte of the encapsulation and of each run of constants in a message."""
    places, place = [(0, len(ENCAPSULATION))], len(ENCAPSULATION) + 8  # the stamp
    for constant, run in zip(layout.constants, layout.runs, strict=True):
        places.append((place, place + len(constant)))
        place += len(constant) + 8 * run
    return places


@cache
def meaningful(layout: Layout) -> NDArray[np.bool_]:
    """For each byte of a message, True where it is constant and a decoder looks at it. Bytes of CDR's alignment gaps
    are not: other writers fill them with whatever was in memory.

    Found by trial: a byte means nothing when the message decodes to the same with any other byte in its place.
    """
    template = layout.pack(0, *(0.0 for _ in layout.columns))
    expected = _text(template, layout)
    mask = np.zeros(layout.size, np.bool_)
    for first, end in constant_places(layout):
        mask[first:end] = True
    for place in np.flatnonzero(mask)[len(ENCAPSULATION) :]:
        # Gaps are zero in a layout's constants; anything else is a letter or a number.
        if template[place] == 0:
            changed = bytearray(template)
            changed[place] = 0xFF
            mask[place] = _text(bytes(changed), layout) != expected
    mask.setflags(write=False)
    return mask


def _text(message: bytes, layout: Layout) -> str:
    try:
        return repr(typestore().deserialize_cdr(message, layout.type_name))
    except Exception as error:  # Of any kind: the byte meant something.
        return repr(error)
