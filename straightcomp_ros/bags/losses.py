"""Counts the messages that a recording lacks, from the stamps of those that it has."""

from __future__ import annotations

import struct
from collections.abc import Mapping

_STAMP = struct.Struct("<iI")
_STAMP_PLACE = 4
"""A header's stamp follows the four bytes of the CDR encapsulation."""


class Losses:
    """Gaps in streams whose stamps lie on a grid: every stream of the loop carries its sample's stamp.

    The sampling period is the smallest step between two stamps of the same topic.
    """

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._steps: dict[str, dict[int, int]] = {}

    def add(self, topic: str, data: bytes) -> None:
        """A serialised message that begins with a header."""
        sec, nanosec = _STAMP.unpack_from(data, _STAMP_PLACE)
        stamp = sec * 1_000_000_000 + nanosec
        last = self._last.get(topic)
        if last is None:
            self._steps.setdefault(topic, {})
        elif stamp <= last:
            return  # repeated or overtaken
        else:
            steps = self._steps[topic]
            steps[stamp - last] = steps.get(stamp - last, 0) + 1
        self._last[topic] = stamp

    def interrupt(self) -> None:
        """What comes next does not follow what came last: between them messages were left out on purpose."""
        self._last.clear()

    def by_topic(self) -> Mapping[str, int]:
        """Messages missing between the first and the last, by topic."""
        return {
            topic: sum((round(step / min(steps)) - 1) * count for step, count in steps.items()) if steps else 0
            for topic, steps in self._steps.items()
        }
