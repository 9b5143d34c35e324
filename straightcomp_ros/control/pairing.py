"""Brings each sample together with its reference; either may come first."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

_WAITING = 1000
"""Halves that wait for their other half: half a second of samples."""

Pair = tuple[int, Sequence[float], Sequence[float]]


class Pairing:
    """Matches samples and references by stamp; what finds no partner is forgotten in time and counted."""

    def __init__(self) -> None:
        self._samples: dict[int, Sequence[float]] = {}
        self._references: dict[int, Sequence[float]] = {}
        self.ready: deque[Pair] = deque()
        """Complete pairs (stamp in ns, sample, reference) in the order of completion."""
        self.unmatched = 0
        """Halves that were forgotten without a partner."""

    def add_sample(self, stamp_ns: int, sample: Sequence[float]) -> None:
        """A sample came; its reference may be here already."""
        reference = self._references.pop(stamp_ns, None)
        if reference is None:
            self._keep(self._samples, stamp_ns, sample)
        else:
            self.ready.append((stamp_ns, sample, reference))

    def add_reference(self, stamp_ns: int, reference: Sequence[float]) -> None:
        """A reference came; its sample is usually here already."""
        sample = self._samples.pop(stamp_ns, None)
        if sample is None:
            self._keep(self._references, stamp_ns, reference)
        else:
            self.ready.append((stamp_ns, sample, reference))

    def _keep(self, halves: dict[int, Sequence[float]], stamp_ns: int, half: Sequence[float]) -> None:
        halves[stamp_ns] = half
        if len(halves) > _WAITING:
            del halves[next(iter(halves))]
            self.unmatched += 1
