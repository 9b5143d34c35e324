"""Faults of a bus, made on purpose: what happens to frames at given rates, repeatable by a seed."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping

from straightcomp_ros.hardware.can.hub_packet import Flag, Frame

FLOOD = 20
"""Frames that a babbling node sends for one of ours."""
_FOREIGN_ID = 0x7


class LinkCut(Exception):
    """The bus is gone for all that are on it."""


class Faults:
    """``faults(frame)``: the frames that arrive in the place of one that was sent.

    A frame suffers one fault at most. ``injected`` counts what was done, by kind.

    Args:
        rates: probability for each frame, by kind; see :data:`KINDS`.
        seed: of the pseudorandom choice.

    Raises:
        ValueError: a kind is unknown, or its rate is not between 0 and 1.
    """

    def __init__(self, rates: Mapping[str, float], seed: int = 0) -> None:
        for kind, rate in rates.items():
            if kind not in KINDS:
                raise ValueError(f"fault '{kind}' is unknown; allowed: {', '.join(KINDS)}")
            if not 0.0 <= rate <= 1.0:
                raise ValueError(f"fault '{kind}': rate of {rate} is not allowed; allowed: 0 to 1")
        self._rates = dict(rates)
        self._random = random.Random(seed)
        self._held: Frame | None = None
        self.injected = dict.fromkeys(rates, 0)

    def __call__(self, frame: Frame) -> list[Frame]:
        """The frames that arrive.

        Raises:
            LinkCut: the link is cut now.
        """
        held, self._held = self._held, None
        if held is not None:
            # A swap needs two frames of a kind: numbers of one counter.
            if held.identifier == frame.identifier:
                self.injected["reorder"] += 1
                return [frame, held]
            return [held, *self(frame)]
        for kind, rate in self._rates.items():
            if self._random.random() < rate:
                frames = KINDS[kind](self, frame)
                if kind != "reorder":
                    self.injected[kind] += 1
                return frames
        return [frame]

    def _drop(self, _: Frame) -> list[Frame]:
        return []

    def _duplicate(self, frame: Frame) -> list[Frame]:
        return [frame, frame]

    def _reorder(self, frame: Frame) -> list[Frame]:
        self._held = frame
        return []

    def _corrupt(self, frame: Frame) -> list[Frame]:
        """One or two wrong bits: the most that the CRC promises to find."""
        bits = self._random.sample(range(8 * len(frame.data)), min(self._random.randint(1, 2), 8 * len(frame.data)))
        value = int.from_bytes(frame.data, "little")
        for bit in bits:
            value ^= 1 << bit
        return [frame._replace(data=value.to_bytes(len(frame.data), "little"))]

    def _garble(self, frame: Frame) -> list[Frame]:
        """Any content: one in 256 passes the CRC."""
        return [frame._replace(data=self._random.randbytes(len(frame.data)))]

    def _truncate(self, frame: Frame) -> list[Frame]:
        return [frame._replace(data=frame.data[: self._random.randrange(len(frame.data))])]

    def _wrong_id(self, frame: Frame) -> list[Frame]:
        return [frame._replace(identifier=frame.identifier ^ 1 << self._random.randrange(11))]

    def _error_frame(self, frame: Frame) -> list[Frame]:
        return [Frame(frame.stamp_ns, 0x20, Flag.ERROR, bytes(8)), frame]

    def _flood(self, frame: Frame) -> list[Frame]:
        return [frame._replace(identifier=_FOREIGN_ID)] * FLOOD + [frame]

    def _cut(self, _: Frame) -> list[Frame]:
        self.injected["cut"] += 1
        raise LinkCut


KINDS: Mapping[str, Callable[[Faults, Frame], list[Frame]]] = {
    "drop": Faults._drop,
    "duplicate": Faults._duplicate,
    "reorder": Faults._reorder,
    "corrupt": Faults._corrupt,
    "garble": Faults._garble,
    "truncate": Faults._truncate,
    "wrong_id": Faults._wrong_id,
    "error_frame": Faults._error_frame,
    "flood": Faults._flood,
    "cut": Faults._cut,
}
"""Kinds of faults, and what each does to a frame."""
