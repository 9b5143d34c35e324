"""The messages of one stream as columns: whole blocks through a layout, odd messages one by one through rosbags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.definitions import typestore
from straightcomp_ros.bags.padding import constant_places, meaningful
from straightcomp_ros.bags.places import FRAME_SIZE, MESSAGE, rows
from straightcomp_ros.messages.cdr import NANOSECONDS, Layout, LayoutMismatch, read_by_names


@dataclass(frozen=True)
class StreamColumns:
    """Messages of one topic, in the order in which they were recorded.

    Attributes:
        log_time: (n,) int64, when each was received, ns since the epoch.
        publish_time: (n,) int64, when its source made it, ns since the epoch.
        stamp: (n,) int64, the stamp of its header, ns since the epoch.
        columns: (n,) float64 for each column of the layout, in the units of the stream.
    """

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    stamp: NDArray[np.int64]
    columns: dict[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.stamp)


class StreamDecoder:
    """Gathers the messages of one topic.

    Args:
        topic: names the topic, and the bag, in errors.
        layout: what its messages should look like.
    """

    def __init__(self, topic: str, layout: Layout) -> None:
        self._topic, self._layout = topic, layout
        self._dtype = layout.dtype
        self._template = np.frombuffer(layout.pack(0, *(0.0 for _ in layout.columns)), np.uint8)
        self._constants = constant_places(layout)
        self._parts: list[StreamColumns] = []

    def add(self, data: bytes, places: NDArray[np.int64]) -> None:
        """Decode the message records at ``places`` in ``data``.

        Raises:
            BagError: a message is neither of the layout nor decodes to its joints and arrays.
        """
        heads = rows(data, places, MESSAGE)
        lengths = heads["length"].astype(np.int64)
        stamp = np.empty(len(places), np.int64)
        numbers = np.empty((len(self._layout.columns), len(places)))
        fits = lengths >= MESSAGE.itemsize - FRAME_SIZE + self._layout.size
        messages = rows(data, places[fits] + MESSAGE.itemsize, self._dtype)
        same = self._same_constants(messages)
        fits[fits] = same
        if fits.all():
            stamp[:], numbers[:] = self._read(messages)
        else:
            stamp[fits], numbers[:, fits] = self._read(messages[same])
        for odd in np.flatnonzero(~fits):
            start = int(places[odd])
            message = data[start + MESSAGE.itemsize : start + FRAME_SIZE + int(lengths[odd])]
            stamp[odd], numbers[:, odd] = self._decoded(message, int(odd))
        log_time, publish_time = heads["log_time"].astype(np.int64), heads["publish_time"].astype(np.int64)
        columns = dict(zip(self._layout.columns, numbers, strict=True))
        self._parts.append(StreamColumns(log_time, publish_time, stamp, columns))

    def finished(self) -> StreamColumns | None:
        """All messages so far; None when there was none."""
        if not self._parts:
            return None
        return StreamColumns(
            np.concatenate([part.log_time for part in self._parts]),
            np.concatenate([part.publish_time for part in self._parts]),
            np.concatenate([part.stamp for part in self._parts]),
            {name: np.concatenate([part.columns[name] for part in self._parts]) for name in self._layout.columns},
        )

    def _read(self, messages: NDArray[np.void]) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
        stamp = messages["sec"].astype(np.int64) * NANOSECONDS + messages["nanosec"]
        return stamp, [messages[name] for name in self._layout.columns]

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

    def _decoded(self, message: bytes, place: int) -> tuple[int, list[float]]:
        try:
            return read_by_names(self._layout, typestore().deserialize_cdr(message, self._layout.type_name))
        except LayoutMismatch as error:
            reason = f"lacks {error}"
        except Exception as error:  # Whatever the decoder stumbles over in bytes that are no such message.
            reason = f"does not decode ({error})"
        raise BagError(
            f"{self._topic}: message {sum(map(len, self._parts)) + place} {reason}; "
            f"allowed is a {self._layout.type_name} with {', '.join(self._layout.columns)}"
        )
