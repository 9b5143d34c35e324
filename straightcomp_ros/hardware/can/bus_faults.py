"""Fault injection on a bus: frames suffer faults at given rates, repeatable by a seed."""

import random
from collections.abc import Callable, Mapping

from straightcomp_ros.hardware.can.hub import EXTENDED, REMOTE, Flag, Frame, LinkCut

FLOOD = 20
"""Frames that a babbling node sends before each of ours."""
_FOREIGN_ID = 0x7


class Faults:
    """``faults(frame)``: the frames that arrive in place of one that was sent.

    A frame suffers one fault at most. ``rates`` are probabilities per frame, by kind; ``injected`` counts the faults.

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
        self.random = random.Random(seed)
        self._held: Frame | None = None
        self.injected = dict.fromkeys(rates, 0)

    def __call__(self, frame: Frame) -> list[Frame]:
        """The frames that arrive; raises LinkCut where the link is cut."""
        held, self._held = self._held, None
        if held is not None:
            # Only frames with one identifier share a counter, so only these are swapped.
            if held.identifier == frame.identifier:
                self.injected["reorder"] += 1
                return [frame, held]
            return [held, *self(frame)]
        for kind, rate in self._rates.items():
            if self.random.random() < rate:
                frames = KINDS[kind](self, frame)
                if kind != "reorder":
                    self.injected[kind] += 1
                return frames
        return [frame]

    def _reorder(self, frame: Frame) -> list[Frame]:
        self._held = frame
        return []

    def _corrupt(self, frame: Frame) -> list[Frame]:
        """One or two wrong bits: the most that the CRC promises to find."""
        bits = self.random.sample(range(8 * len(frame.data)), min(self.random.randint(1, 2), 8 * len(frame.data)))
        value = int.from_bytes(frame.data, "little")
        for bit in bits:
            value ^= 1 << bit
        return [frame._replace(data=value.to_bytes(len(frame.data), "little"))]

    def _cut(self, _: Frame) -> list[Frame]:
        self.injected["cut"] += 1
        raise LinkCut


KINDS: Mapping[str, Callable[[Faults, Frame], list[Frame]]] = {
    "drop": lambda faults, frame: [],
    "duplicate": lambda faults, frame: [frame, frame],
    "reorder": Faults._reorder,
    "corrupt": Faults._corrupt,
    # Any content: one in 256 passes the CRC.
    "garble": lambda faults, frame: [frame._replace(data=faults.random.randbytes(len(frame.data)))],
    "truncate": lambda faults, frame: [frame._replace(data=frame.data[: faults.random.randrange(len(frame.data))])],
    "wrong_id": lambda faults, frame: [frame._replace(identifier=frame.identifier ^ 1 << faults.random.randrange(11))],
    "error_frame": lambda faults, frame: [Frame(frame.stamp_ns, 0x20, Flag.ERROR, bytes(8)), frame],
    # A request for the frame, which a bus has in the classic format alone.
    "remote": lambda faults, frame: [frame._replace(flags=frame.flags & EXTENDED | REMOTE, data=b""), frame],
    "flood": lambda faults, frame: [frame._replace(identifier=_FOREIGN_ID)] * FLOOD + [frame],
    "cut": Faults._cut,
}
"""Kinds of faults, and what each does to a frame."""
