"""Decimated series of the plots, kept for a while, and handed out to each page as far as it has not got them."""

import math
import threading
from collections import deque
from collections.abc import Iterable, Sequence

_KEEP_S = 20.0


class Series:
    """One quantity in slots of equal length, each with the least and the greatest value: no peak is lost.

    Args:
        slot: length of a slot, s.
        scale: shown unit per SI unit, e.g. 1e6 for µm.
    """

    def __init__(self, slot: float, scale: float) -> None:
        self._slot_ns, self._scale = round(slot * 1e9), scale
        self._slots: deque[list[float]] = deque(maxlen=round(_KEEP_S / slot))
        self._number, self._low, self._high = -1, math.inf, -math.inf

    def add(self, samples: Iterable[tuple[int, float]]) -> None:
        """Add samples: (stamp in ns, value in SI units). Values that are not finite leave their slot as it is."""
        for stamp_ns, value in samples:
            number = stamp_ns // self._slot_ns
            if number != self._number:
                self._close(number)
            if math.isfinite(value):
                self._low, self._high = min(self._low, value), max(self._high, value)

    def _close(self, number: int) -> None:
        if number < self._number:
            # The source was started anew.
            self._slots.clear()
        elif self._low <= self._high:
            values = (float(f"{value * self._scale:.5g}") for value in (self._low, self._high))
            self._slots.append([self._number, self._number * self._slot_ns * 1e-9, *values])
        self._number, self._low, self._high = number, math.inf, -math.inf

    def after(self, number: int) -> list[list[float]]:
        """Finished slots after slot ``number``: [number, time in s since the epoch, least, greatest], to 5 digits."""
        return [slot for slot in self._slots if slot[0] > number]

    @property
    def newest(self) -> int:
        """Number of the newest finished slot; -1 without any."""
        return int(self._slots[-1][0]) if self._slots else -1


class Board:
    """All series by name and the present state, written by one thread and read by those that serve pages."""

    def __init__(self, series: dict[str, Series]) -> None:
        self._series = series
        self._state: dict[str, object] = {}
        self._lock = threading.Lock()

    def add(self, name: str, samples: Sequence[tuple[int, float]]) -> None:
        """Add samples to one series."""
        with self._lock:
            self._series[name].add(samples)

    def show(self, state: dict[str, object]) -> None:
        """The state from now on."""
        with self._lock:
            self._state = state

    def news(self, seen: dict[str, int]) -> dict[str, object]:
        """State, and what each series has after the slot that ``seen`` names, which is then brought up to date."""
        with self._lock:
            fresh = {}
            for name, series in self._series.items():
                last = seen.get(name, -1)
                # A source that was started anew counts from the beginning.
                fresh[name] = series.after(last if last <= series.newest else -1)
                seen[name] = series.newest
            return {"state": self._state, "series": fresh}
