"""The board's sampling clock in the host's time: a stamp for each sample number.

Frames are late by a varying amount, but never early. The stamps therefore follow a line through the promptest frame of
each block. A first-order correction of its offset and an integral correction of its rate make it follow a quartz that
is off by 100 ppm and more. The line bends but never jumps: stamps rise by about a period each.
"""

BLOCK = 128
"""Samples of a block: 64 ms at 2 kHz."""
_PLACE_GAIN, _RATE_GAIN = 0.5, 0.1
_MOST_CORRECTION = 0.1
"""Of the offset, in periods per block: a stalled host must not drag the clock along."""
_MOST_EARLY = 16.0
"""Periods: an eighth of a block, so that stamps still rise while the line is corrected."""
_MOST_RATE = 1e-3
_LOST_PERIODS, _LOST_BLOCKS = 4.0, 4


class SampleClock:
    """Line ``stamp(index)`` in ns through the times of arrival; :attr:`settled` after the first block.

    A stamp is late by the shortest time from sampling to arrival. ``period_ns`` is the nominal sampling period.
    """

    def __init__(self, period_ns: int) -> None:
        self._nominal = float(period_ns)
        self.reset()

    def reset(self) -> None:
        self.settled = False
        self._origin_index = self._origin_ns = self._count = self._lost_blocks = 0
        self._place = self._rate = self._bend = 0.0
        self._slope = self._nominal
        self._least = float("inf")

    def stamp(self, index: int) -> int:
        """Time of the sample ``index`` in ns."""
        return self._origin_ns + round(self._place + (index - self._origin_index) * self._slope)

    def elapsed(self, index: int, arrival_ns: int) -> float:
        """Samples that the board has taken since ``index`` by the time ``arrival_ns``."""
        return (arrival_ns - self.stamp(index)) / self._slope

    def observe(self, index: int, arrival_ns: int) -> None:
        """Take the time of arrival of a sample; samples come in order, some may be missing."""
        if self._count == 0 and not self.settled:
            self._origin_index, self._origin_ns = index, arrival_ns
        step = index - self._origin_index
        late = arrival_ns - self._origin_ns - self._place - step * self._slope
        # As seen from the end of the block, when the line has been bent.
        late -= (BLOCK - step) * self._bend
        if late < self._least:
            self._least = late
        self._count += 1
        if step >= BLOCK - 1:
            self._end_block(index)

    def _end_block(self, index: int) -> None:
        late, self._least, self._count = self._least, float("inf"), 0
        if not self.settled:
            self._place += late
            self.settled = True
            return
        # An error of whole periods in block after block is no jitter: the board's clock was interrupted.
        self._lost_blocks = self._lost_blocks + 1 if abs(late) > _LOST_PERIODS * self._nominal else 0
        if self._lost_blocks >= _LOST_BLOCKS:
            self.reset()
            return
        # Late frames prove little, but an early one proves that the line is too late.
        late = min(max(late, -_MOST_EARLY * self._nominal), _MOST_CORRECTION * self._nominal)
        usual = max(late, -_MOST_CORRECTION * self._nominal)
        self._rate = min(max(self._rate + _RATE_GAIN * usual / BLOCK / self._nominal, -_MOST_RATE), _MOST_RATE)
        here = self._place + (index - self._origin_index) * self._slope
        whole = round(here)
        self._origin_index, self._origin_ns, self._place = index, self._origin_ns + whole, here - whole
        self._bend = _PLACE_GAIN * late / BLOCK
        self._slope = self._nominal * (1.0 + self._rate) + self._bend
