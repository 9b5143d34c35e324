"""DBC files that hypothesis draws: signals of both byte orders, signed, unsigned, float and multiplexed."""

from dataclasses import dataclass

from hypothesis import strategies as st

SIZES = (1, 2, 3, 5, 7, 8, 8, 8, 12, 16, 64)


@dataclass(frozen=True)
class Drawn:
    """One signal of a drawn message; ``page`` is its multiplexer page, "M" for the multiplexer itself."""

    name: str
    start: int
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float
    offset: float
    page: str

    def line(self):
        page = {"": "", "M": " M"}.get(self.page, f" m{self.page}")
        order, sign = int(not self.big_endian), "-" if self.signed or self.is_float else "+"
        place = f"{self.start}|{self.length}@{order}{sign} ({self.scale},{self.offset})"
        return f' SG_ {self.name}{page} : {place} [0|0] "" B'


def place(position, length, big_endian):
    """Start bit of a signal whose bits are the ``length`` from ``position`` on, counted in its own byte order."""
    if not big_endian:
        return position
    byte, bit = divmod(position, 8)
    return 8 * byte + 7 - bit


@st.composite
def messages(draw):
    """A message as (payload size, signals); signals of the same page do not overlap."""
    size = draw(st.sampled_from(SIZES))
    multiplexed = draw(st.booleans())
    first = draw(st.booleans())
    signals = [Drawn("Page", place(0, 4, first), 4, first, False, False, 1, 0, "M")] if multiplexed else []
    for page in ("1", "3") if multiplexed else ("",):
        position, order = 4 if multiplexed else 0, first
        while position < 8 * size:
            # Whole bytes of one order: those of the other never overlap them.
            end = min(8 * (position // 8 + draw(st.sampled_from([1, 2, 4, 8, 8]))), 8 * size)
            if position >= 8:
                order = draw(st.booleans())
            while position < end:
                signal = draw(signal_at(position, end - position, order, f"Signal{len(signals)}", page))
                position += signal.length
                if len(signals) < 2 or draw(st.booleans()):
                    signals.append(signal)
    return size, signals


@st.composite
def signal_at(draw, position, room, big_endian, name, page):
    """A signal of at most ``room`` bits."""
    whole = [bits for bits in (8, 16, 32, 64) if bits <= room]
    is_float = room >= 32 and draw(st.booleans())
    if is_float:
        length = draw(st.sampled_from([bits for bits in whole if bits >= 32]))
    elif whole and draw(st.booleans()):
        length = draw(st.sampled_from(whole))
    else:
        length = draw(st.integers(1, min(64, room)))
    signed = not is_float and draw(st.booleans())
    scale, offset = draw(st.sampled_from([(1, 0), (0.5, 0), (1e-7, 0), (-0.25, 3), (2, -100), (1, 40)]))
    start = place(position, length, big_endian)
    return Drawn(name, start, length, big_endian, signed, is_float, scale, offset, page)


def dbc_text(drawn):
    """A DBC file with all these messages."""
    lines = ['VERSION "1"', "NS_ :", "BS_:", "BU_: A B", ""]
    types = []
    for number, (size, signals) in enumerate(drawn):
        lines += [f"BO_ {number + 1} Message{number}: {size} A", *(signal.line() for signal in signals), ""]
        types += [
            f"SIG_VALTYPE_ {number + 1} {signal.name} : {1 if signal.length == 32 else 2};"
            for signal in signals
            if signal.is_float
        ]
    return "\n".join([*lines, *types, ""])
