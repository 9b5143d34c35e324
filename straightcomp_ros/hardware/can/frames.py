"""The frames between a board and its host: what they say, their bits, their CRC and counter.

One table per message has the place of each signal; CRC, counter, states and units are further columns of it. How the
signals lie in the payload is in the DBC file alone.

CRCs, whatever their place in the payload, run over all of it but themselves. Sources: AUTOSAR FO PRS_E2EProtocol,
profiles 1 (E2E_P01_DATAID_BOTH), 2 and 5; SAE J1850. fastcrc computes them.

Profile 1: CRC-8 of polynomial 0x1D with start and final XOR 0, over the 16-bit data id, low byte first, and then the
payload. The polynomial is primitive, of order 255: in frames of up to 30 bytes it finds any two wrong bits and any
error burst of up to eight bits; of all other errors, 255 in 256.
Profile 2: CRC-8 of polynomial 0x2F, start and final XOR 0xFF, over the payload and that one of 16 data ids that the
counter chooses.
Profile 5: CRC-16 of polynomial 0x1021, start 0xFFFF, over the payload and the 16-bit data id, low byte first.
J1850: CRC-8 of polynomial 0x1D, start and final XOR 0xFF, over the payload; it has no data id.
The frames of config/emulator.dbc have the CRC-32 of zlib.
"""

from __future__ import annotations

import enum
import math
import struct
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, NoReturn

from fastcrc import crc8, crc16

from straightcomp_ros.hardware.can.dbc_file import (
    FLOATS,
    LARGEST_FLOAT,
    DbcError,
    byte_order,
    in_page,
    is_fd,
    limits,
    modulus,
    pages,
    selectors,
    shift,
)
from straightcomp_ros.hardware.interface import State

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_EXACT, _DIGITS = 17, 15
"""Significant digits: those that keep a float to the bit, and those that make 900000 µA to 0.9 A."""
_ROUNDED = 1e-12
"""Share of an end by which a float may be beyond it: that of scales and units."""
_NEW = tuple.__new__
"""Makes a named tuple in half the time of the class's own constructor."""
_BY_CODE = "fault"
"""Stands for the raw value of the amplifier's state where the fault code alone says that there is a fault."""


class BoardFault(enum.IntEnum):
    """Why the emulated board switched off; the DBC file's table of the fault's values has these names."""

    NONE = 0
    COMMAND_TIMEOUT = 1
    COMMAND_CHECK = 2
    CURRENT_RANGE = 3
    ENCODER = 4
    OVERCURRENT = 5
    SUPPLY = 6
    INTERNAL = 7


class FrameError(ValueError):
    """A frame fails its check; its text is the name under which such frames are counted."""


class Report(NamedTuple):
    """A frame of the board. What is not in the frame is None, except for ``good``.

    ``alive`` counts the frames of one identifier, ``counter`` the samples; ``x``, ``y`` and the coil ``current`` are in
    m and A, of the sample that the frame belongs to, NaN for a current beyond its limits; ``fault`` is the board's own
    code; ``good`` says whether both readings may be used, ``referenced`` whether x is counted from its reference.
    """

    alive: int | None = None
    counter: int | None = None
    x: float | None = None
    y: float | None = None
    current: float | None = None
    amplifier: State | None = None
    fault: int | None = None
    good: bool = True
    referenced: bool | None = None

    @property
    def number(self) -> int | None:
        """What numbers the sample: the counter of the samples if the frame has it, else that of the frames."""
        return self.alive if self.counter is None else self.counter


_AMPLIFIER, _FAULT, _GOOD = map(Report._fields.index, ("amplifier", "fault", "good"))


class Command(NamedTuple):
    """What the host asks for. What is not in the frame is None.

    ``alive`` counts the frames of one identifier; ``current`` is the control current in A; ``echo`` is the number of
    the sample that is answered, as far as the frame has room.
    """

    alive: int | None = None
    enable: bool | None = None
    reset: bool | None = None
    current: float | None = None
    echo: int | None = None


UNITS = {"x": "m", "y": "m", "current": "A"}
"""SI unit of each field of a report or command that has a physical value."""


class _Profile(NamedTuple):
    bits: int
    function: Callable[[bytes], int]
    ids: int = 0
    """Number of its data ids."""
    largest_id: int = 0
    reserved: int | None = None
    """First count that no frame has: profile 1 keeps 15 for "not valid"."""


PROFILES = {
    "e2e_1": _Profile(8, crc8.gsm_a, 1, 0xFFFF, 15),
    "e2e_2": _Profile(8, crc8.autosar, 16, 0xFF),
    "e2e_5": _Profile(16, crc16.ibm_3740, 1, 0xFFFF),
    "j1850": _Profile(8, crc8.sae_j1850),
    "crc_32": _Profile(32, zlib.crc32),
}


def data_ids(text: str, profile: str, identifier: int) -> list[int]:
    """The data ids in ``text``; without any, the low 16 bits of the CAN identifier.

    Raises:
        DbcError: other numbers than the profile needs.
    """
    wanted, largest = PROFILES[profile].ids, PROFILES[profile].largest_id
    if not text and wanted < 2:
        return [identifier & 0xFFFF] * wanted
    if not wanted:
        raise DbcError(f"'{text}' is not allowed with profile {profile}, which has no data id")
    try:
        numbers = [int(word, 0) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != wanted or not all(0 <= number <= largest for number in numbers):
        raise DbcError(f"'{text}' is not allowed with profile {profile}; allowed: {wanted} of 0 to {largest:#x}")
    return numbers


class Crc:
    """The CRC of one message, which begins at byte ``begin`` of the payload in byte order ``order``.

    ``by_identifier``: the data id is the CAN identifier.

    Raises:
        DbcError: signal or data id do not suit the profile; the message does not name the parameter.
    """

    def __init__(
        self,
        message: Message,
        crc: Signal,
        alive: Signal | None,
        profile: str,
        data_id: list[int],
        *,
        by_identifier: bool = False,
    ) -> None:
        self.profile, self.data_id, self.by_identifier = profile, data_id, by_identifier
        bits, self._function = PROFILES[profile][:2]
        self.begin, self.order, self._size = crc.start // 8, byte_order(crc), bits // 8
        first = 0 if self.order == "little" else 7
        if crc.length != bits or crc.start % 8 != first or crc.is_float or crc.is_signed:
            raise DbcError(
                f"CRC signal '{crc.name}' of message '{message.name}' has {crc.length} bits from bit {crc.start} on; "
                f"allowed with profile {profile}: {bits} bits, unsigned, whole bytes"
            )
        if profile == "e2e_2" and (alive is None or alive.length != 4):
            raise DbcError(f"profile e2e_2 of message '{message.name}' needs a counter 'alive' of 4 bits")
        if profile == "e2e_1":
            # It begins with the data id, so with the CRC of that: the final XOR is 0.
            self._function = partial(crc8.gsm_a, initial=crc8.gsm_a(data_id[0].to_bytes(2, "little")))
        self._ends = [one.to_bytes(self._size, "little") for one in data_id] if profile in ("e2e_2", "e2e_5") else []
        """Bytes behind the payload; of several, the counter chooses one."""
        self._counted = (byte_order(alive), shift(alive, message.length)) if alive and profile == "e2e_2" else None

    def of(self, payload: bytes) -> int:
        """The CRC that belongs into ``payload``."""
        content = payload[: self.begin] + payload[self.begin + self._size :]
        if self._counted:
            order, place = self._counted
            content += self._ends[int.from_bytes(payload, order) >> place & 15]
        elif self._ends:
            content += self._ends[0]
        return self._function(content)

    def fits(self, payload: bytes) -> bool:
        """Whether ``payload`` has its CRC."""
        return self.of(payload) == int.from_bytes(payload[self.begin : self.begin + self._size], self.order)

    def sealed(self, payload: bytes) -> bytes:
        """``payload`` with its CRC."""
        crc = self.of(payload).to_bytes(self._size, self.order)
        return payload[: self.begin] + crc + payload[self.begin + self._size :]


class _Meanings(dict[Any, Any]):
    """What each raw value says; any other says ``other``, or is refused by ``reason`` where that is None."""

    other: Any = None
    reason = ""

    def __missing__(self, raw: int) -> Any:
        if self.other is None:
            raise FrameError(self.reason)
        return self.other


class Frames:
    """The frames of one identifier, see EXTENDED_ID: packs and unpacks them by a table of their signals.

    Args:
        fields: the signals that mean something, by the field of ``kind``.
        factors: of the fields with a physical value, from the file's unit to SI units.
        values: of the fields that say something the raw value of each meaning.
        kind: what :meth:`unpack` returns, and :meth:`pack` takes; None: a plain tuple of ``fields``.
        no_fault: the bits of the board's code of no fault.
        wraps: x goes on at the other end of its signal's range, as an encoder's counter does; any x can be packed.

    Attributes:
        spans: least and largest value in SI units, by each field in ``factors``.
        every: number of samples from one frame to the next.
        alive_modulus: of the count of the frames, in the field ``alive``; 1 without.
        period: s from one frame to the next, if the DBC file says it.
    """

    every = 1

    def __init__(
        self,
        message: Message,
        identifier: int,
        fields: Mapping[str, Signal],
        factors: Mapping[str, float] | None = None,
        values: Mapping[str, Mapping[Any, int]] | None = None,
        kind: Any = None,
        crc: Crc | None = None,
        no_fault: int = 0,
        wraps: bool = False,
    ) -> None:
        self.wraps = wraps and "x" in fields
        self.message, self.identifier, self.fields, self.crc = message, identifier, fields, crc
        self.factors = factors or {}
        self.values = {field: raw for field, raw in (values or {}).items() if field in fields}
        self.name, self.size, self.fd = message.name, message.length, is_fd(message)
        self.period = (message.cycle_time or 0) * 1e-3
        counts = modulus(fields["alive"]) if "alive" in fields else 1
        self.alive_modulus = min(counts, (crc and PROFILES[crc.profile].reserved) or counts)
        self.spans = {field: self._span(field, _DIGITS) for field in self.factors}
        self.kind, self._no_fault = kind or tuple, no_fault
        self._order: list[str] = list(kind._fields if kind else fields)
        orders = {byte_order(signal) for signal in message.signals}
        self._bytes: Literal["little", "big"] = "big" if orders == {"big"} else "little"
        # Bits of a signal of the other order are counted behind those of the payload, in the payload turned round.
        self._behind = 8 * self.size if len(orders) > 1 else 0
        self._selectors = {
            field: [(*self._bits(one), _sign(one), ids) for one, ids in selectors(message, signal)]
            for field, signal in fields.items()
        }
        self._page_tables: dict[tuple[str, ...], tuple[Any, ...]] = {}
        self._whole_table = None if any(self._selectors.values()) else self._table(fields)
        self.pages = pages(message, fields.values())
        self._packings = [self._packing(page) for page in self.pages]

    def counts(self, field: str) -> int:
        """Modulus of the counter in ``field``, 0 without one."""
        if field not in self.fields:
            return 0
        return self.alive_modulus if field == "alive" else modulus(self.fields[field])

    @property
    def sample_modulus(self) -> int:
        """Of what counts these frames: the count of the samples if they have it, else that of the frames; or 0."""
        return self.counts("counter") or self.counts("alive")

    def step(self, field: str) -> float:
        """Resolution of ``field`` in SI units; 0 for a float."""
        signal = self.fields[field]
        return 0.0 if signal.is_float else abs(signal.scale * self.factors[field])

    def _span(self, field: str, digits: int) -> tuple[float, float]:
        """Least and largest value in SI units, with so many digits; never infinite, so that no reading may be."""
        scale, offset = self._line(field)
        ends = (float(f"{raw * scale + offset:.{digits}g}") for raw in self._ends(field))
        least, largest = sorted(min(max(end, -LARGEST_FLOAT[64]), LARGEST_FLOAT[64]) for end in ends)
        return least, largest

    def _ends(self, field: str) -> tuple[float, float]:
        """Least and largest raw value."""
        signal = self.fields[field]
        if self.wraps and field == "x":
            least = -(2 ** (signal.length - 1)) if signal.is_signed else 0
            return least, least + 2**signal.length - 1
        return limits(signal)

    @property
    def turn(self) -> tuple[float, float]:
        """Where x in m begins, and where it ends, as the count of its signal rises."""
        (scale, offset), (least, largest) = self._line("x"), self._ends("x")
        return least * scale + offset, largest * scale + offset

    @property
    def x_modulus(self) -> float:
        """Distance in m after which x repeats itself; 0 if it does not."""
        return 2 ** self.fields["x"].length * self.step("x") if self.wraps else 0.0

    def _bits(self, signal: Signal) -> tuple[int, int]:
        """Shift and mask of a signal."""
        behind = self._behind if byte_order(signal) != self._bytes else 0
        return shift(signal, self.size) + behind, (1 << signal.length) - 1

    def _line(self, field: str) -> tuple[float, float]:
        """Scale and offset from a raw value to SI units; a whole number without them stays one, and -0.0 stays -0.0."""
        signal, factor = self.fields[field], self.factors.get(field)
        if factor is None or (signal.scale * factor == 1 and not signal.offset and not signal.is_float):
            return 1, 0
        return signal.scale * factor, signal.offset * factor or -0.0

    def _table(self, shown: Collection[str]) -> tuple[Any, ...]:
        """What :meth:`unpack` goes through for frames with the fields ``shown``, each by its place in ``kind``.

        Shift and mask of each, 0 for a field that the frame does not have; moduli of the counters; decoders of
        floats and of meanings; sign bit, scale and offset of numbers; what stands for a field that is absent; ends of a
        good reading, and which field says what beyond them; whether the fault code alone says that there is a fault.
        """
        bits, counted, decoders, numbers, absent, ends = [], [], [], [], [], []
        for at, field in enumerate(self._order):
            if field not in shown:
                bits.append((0, 0))
                absent.append((at, True if field == "good" and field not in self.fields else None))
                continue
            signal, (scale, offset) = self.fields[field], self._line(field)
            bits.append(self._bits(signal))
            if field in ("alive", "counter"):
                counted.append((at, self.counts(field)))
            if field in self.values:
                decoders.append((at, self._meanings(field).__getitem__))
            elif signal.is_float:
                decoders.append((at, partial(_float_of, signal.length, scale, offset)))
            elif _sign(signal) or field in self.factors:
                numbers.append((at, _sign(signal), scale, offset))
            beyond: tuple[int, Any] | None = None
            if self.kind is Report and field in ("x", "y") and ("good" in shown or "good" not in self.fields):
                beyond = _GOOD, False
            elif self.kind is Report and field == "current":
                beyond = at, math.nan
            if beyond:
                ends.append((at, *self._span(field, _EXACT), *beyond))
        by_code = "amplifier" in shown and self.values["amplifier"][State.FAULT] < 0
        return bits, counted, decoders, numbers, absent, ends, by_code

    def _meanings(self, field: str) -> _Meanings:
        """The meaning of each raw value of ``field``."""
        raw_of, mask = self.values[field], (1 << self.fields[field].length) - 1
        found = _Meanings({raw & mask: meaning for meaning, raw in raw_of.items() if raw >= 0 or field != "amplifier"})
        found.reason = "pattern"
        if field in ("good", "referenced"):
            found.other = False
        elif field == "amplifier":
            found[_BY_CODE], found.reason = State.FAULT, "state"
            found.other = State.OFF if raw_of[State.OFF] < 0 else None
        return found

    def unpack(self, payload: bytes) -> Any:
        """What a frame says; raises FrameError."""
        if len(payload) != self.size:
            raise FrameError("length")
        if self.crc is not None and not self.crc.fits(payload):
            raise FrameError("crc")
        whole = int.from_bytes(payload + payload[::-1] if self._behind else payload, self._bytes)
        bits, counted, decoders, numbers, absent, ends, by_code = self._whole_table or self._page_table(whole)
        values: list[Any] = [whole >> place & mask for place, mask in bits]
        for at, counts in counted:
            if values[at] >= counts:
                raise FrameError("alive")
        if by_code and values[_FAULT] != self._no_fault:
            values[_AMPLIFIER] = _BY_CODE
        for at, decode in decoders:
            values[at] = decode(values[at])
        for at, sign, scale, offset in numbers:
            values[at] = ((values[at] ^ sign) - sign) * scale + offset
        for at, stands_for in absent:
            values[at] = stands_for
        for at, least, largest, instead, beyond in ends:
            if not least <= values[at] <= largest:
                values[instead] = beyond
        return _NEW(self.kind, values)

    def _page_table(self, whole: int) -> tuple[Any, ...]:
        """The table of a frame with multiplexed signals, of which ``whole`` are the bits."""
        shown = tuple(
            field
            for field, chain in self._selectors.items()
            if all(((whole >> place & mask) ^ sign) - sign in ids for place, mask, sign, ids in chain)
        )
        if shown not in self._page_tables:
            self._page_tables[shown] = self._table(shown)
        return self._page_tables[shown]

    def _packing(self, page: Mapping[str, int]) -> tuple[int, list[tuple[int, dict[Any, int]]], list[tuple[Any, ...]]]:
        """What :meth:`pack` goes through with one choice of multiplexer pages: fixed bits, those of meanings, numbers.

        A signal without a field has the initial value of the DBC file, a multiplexer the page.
        """
        fields = {signal.name: field for field, signal in self.fields.items()}
        fixed, said, rows = 0, [], []
        for signal in self.message.signals:
            place, mask = self._bits(signal)
            letter = FLOATS[signal.length] if signal.is_float else ""
            field, shown = fields.get(signal.name), in_page(self.message, signal, page)
            if field is None or not shown:
                value = page.get(signal.name, signal.raw_initial if shown else 0) or 0
                fixed |= (_float_bits(letter, value) if letter else int(value) & mask) << place
                continue
            at, (scale, offset), (least, largest) = self._order.index(field), self._line(field), self._ends(field)
            if field in self.values:
                raw_of = sent_values(self.values[field]) if field == "amplifier" else self.values[field]
                said.append((at, {meaning: (raw & mask) << place for meaning, raw in raw_of.items()}))
                continue
            if (signal.length == 64 and letter and signal.minimum is None) or (field == "x" and self.wraps):
                least = largest = math.nan
            elif letter:
                least, largest = least - _ROUNDED * abs(least), largest + _ROUNDED * abs(largest)
            elif field in self.factors:
                # A number is refused from half a step beyond the end on.
                least, largest = math.nextafter(least - 0.5, math.inf), math.nextafter(largest + 0.5, -math.inf)
            rows.append((at, scale, offset or 0, least, largest, mask, place, letter, field))
        return fixed, said, rows

    def pack(self, values: Sequence[Any], turn: int = 0) -> bytes:
        """Payload of the ``turn``-th frame: the pages of a multiplexed message take turns.

        Raises:
            ValueError: a value does not fit its signal.
        """
        bits, said, rows = self._packings[turn % len(self._packings)]
        for at, bits_of in said:
            bits |= bits_of[values[at]]
        for at, scale, offset, least, largest, mask, place, letter, field in rows:
            # A whole number without scale stays exact; a comparison with NaN is false.
            raw = values[at] - offset if scale == 1 else (values[at] - offset) / scale
            if not least <= raw <= largest and least == least:
                self._refuse(field, values[at])
            bits |= (_float_bits(letter, raw) if letter else round(raw) & mask) << place
        if self._behind:
            turned = (bits >> self._behind).to_bytes(self.size, "big")
            bits = bits & (1 << self._behind) - 1 | int.from_bytes(turned, "little")
        payload = bits.to_bytes(self.size, self._bytes)
        return payload if self.crc is None else self.crc.sealed(payload)

    def _refuse(self, field: str, value: float) -> NoReturn:
        ends = self.spans[field] if field in self.factors else limits(self.fields[field])
        unit = f" {UNITS[field]}" if field in UNITS else ""
        raise ValueError(
            f"{field} of {value}{unit} does not fit signal '{self.fields[field].name}' of message '{self.name}'; "
            f"allowed: {ends[0]:.9g} to {ends[1]:.9g}{unit}"
        )


def _sign(signal: Signal) -> int:
    """Bit of the sign, 0 without: (bits ^ sign) - sign is the number in two's complement."""
    return 1 << signal.length - 1 if signal.is_signed and not signal.is_float else 0


def _float_of(length: int, scale: float, offset: float, bits: int) -> float:
    (raw,) = struct.unpack(f"<{FLOATS[length]}", bits.to_bytes(length // 8, "little"))
    return float(raw * scale + offset)


def _float_bits(letter: str, value: float) -> int:
    return int.from_bytes(struct.pack(f"<{letter}", value), "little")


def sent_values(values: Mapping[Any, int]) -> dict[Any, int]:
    """The raw value that says each state of the amplifier, also those that have none of their own (-1).

    For "off" that is any that is free; for "fault", which the fault code says, that for "off".
    """
    free = next(raw for raw in range(len(values) + 1) if raw not in values.values())
    sent = {meaning: raw if raw >= 0 else free for meaning, raw in values.items()}
    return sent | {State.FAULT: sent[State.OFF]} if values[State.FAULT] < 0 else sent
