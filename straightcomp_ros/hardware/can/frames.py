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
"""

from __future__ import annotations

import enum
import operator
import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from fastcrc import crc8, crc16

from straightcomp_ros.hardware.can.dbc_file import (
    FLOATS,
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

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_NEW = tuple.__new__
"""Makes a named tuple in half the time of the class's own constructor."""
_BY_CODE = "fault"
"""Stands for the raw value of the amplifier's state where the fault code alone says that there is a fault."""


class Amplifier(enum.IntEnum):
    """State of the board's amplifier."""

    OFF = 1
    ON = 2
    FAULT = 3


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

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ")


class FrameError(ValueError):
    """A frame fails its check; its text is the name under which such frames are counted."""


class Report(NamedTuple):
    """A frame of the board. What is not in the frame is None, except for ``good``.

    ``alive`` counts the frames of one identifier, ``counter`` the samples; ``x``, ``y`` and the coil ``current`` are in
    m and A, of the sample that the frame belongs to; ``fault`` is the board's own code; ``good`` says whether both
    readings may be used.
    """

    alive: int | None = None
    counter: int | None = None
    x: float | None = None
    y: float | None = None
    current: float | None = None
    amplifier: Amplifier | None = None
    fault: int | None = None
    good: bool = True

    @property
    def count(self) -> int | None:
        """What numbers the sample: the counter of the samples if the frame has it, else that of the frames."""
        return self.alive if self.counter is None else self.counter


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
    reserved: int | None = None
    """First count that no frame has: profile 1 keeps 15 for "not valid"."""


PROFILES = {
    "e2e_1": _Profile(8, crc8.gsm_a, 15),
    "e2e_2": _Profile(8, crc8.autosar),
    "e2e_5": _Profile(16, crc16.ibm_3740),
    "j1850": _Profile(8, crc8.sae_j1850),
}
_IDS_OF_2 = 16


def alive_modulus(alive: Signal, profile: str) -> int:
    """Counts of the frame counter before it begins again."""
    counts = modulus(alive)
    return min(counts, PROFILES[profile].reserved or counts) if profile in PROFILES else counts


def data_ids(text: str, profile: str, identifier: int) -> list[int]:
    """The data ids in ``text``; without any, the low 16 bits of the CAN identifier.

    Raises:
        DbcError: other numbers than the profile needs.
    """
    if profile not in ("e2e_1", "e2e_2", "e2e_5"):
        if text:
            raise DbcError(f"'{text}' is not allowed with profile {profile}, which has no data id")
        return []
    wanted, largest = (_IDS_OF_2, 0xFF) if profile == "e2e_2" else (1, 0xFFFF)
    if not text and profile != "e2e_2":
        return [identifier & 0xFFFF]
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
        self.begin, self.order, bits = crc.start // 8, byte_order(crc), PROFILES[profile].bits
        first = 0 if self.order == "little" else 7
        if crc.length != bits or crc.start % 8 != first or crc.is_float or crc.is_signed:
            raise DbcError(
                f"CRC signal '{crc.name}' of message '{message.name}' has {crc.length} bits from bit {crc.start} on; "
                f"allowed with profile {profile}: {bits} bits, unsigned, whole bytes"
            )
        if profile == "e2e_2" and (alive is None or alive.length != 4):
            raise DbcError(f"profile e2e_2 of message '{message.name}' needs a counter 'alive' of 4 bits")
        self._end, self._function = self.begin + bits // 8, PROFILES[profile].function
        if profile == "e2e_1":
            # It begins with the data id, so with the CRC of that: the final XOR is 0.
            self._function = partial(crc8.gsm_a, initial=crc8.gsm_a(data_id[0].to_bytes(2, "little")))
        self._ends = [one.to_bytes(bits // 8, "little") for one in data_id] if profile in ("e2e_2", "e2e_5") else []
        """Bytes behind the payload; of several, the counter chooses one."""
        self._counted = (byte_order(alive), shift(alive, message.length)) if alive and profile == "e2e_2" else None

    def of(self, payload: bytes) -> int:
        """The CRC that belongs into ``payload``."""
        content = payload[: self.begin] + payload[self._end :] if self.begin else payload[self._end :]
        if self._counted:
            order, place = self._counted
            content += self._ends[int.from_bytes(payload, order) >> place & 15]
        elif self._ends:
            content += self._ends[0]
        return self._function(content)

    def fits(self, payload: bytes) -> bool:
        """Whether ``payload`` has its CRC."""
        return self.of(payload) == int.from_bytes(payload[self.begin : self._end], self.order)

    def sealed(self, payload: bytes) -> bytes:
        """``payload`` with its CRC."""
        crc = self.of(payload).to_bytes(self._end - self.begin, self.order)
        return payload[: self.begin] + crc + payload[self._end :]


class _Table(NamedTuple):
    """What unpacking goes through, by the places of the values: bits first, then what is said by them."""

    bits: list[tuple[int, int]]
    """Shift and mask."""
    floats: list[tuple[int, int, Callable[[bytes], tuple[float]]]]
    """Bytes, and the function from them."""
    counted: list[tuple[int, int]]
    """Number of counts, where not all that the bits hold are allowed."""
    code: tuple[int, int] | None
    """Places of state and fault code, where the code alone says that there is a fault."""
    said: list[tuple[int, Callable[[Any, Any], Any], Any, str]]
    """Meaning of each raw value, that of any other, and the error where it has none."""
    numbers: list[tuple[int, int, float, float, tuple[float, float] | None]]
    """Sign bit, scale, offset, and least and largest raw value of a good reading."""
    good: int
    """Place of "both readings are good"."""
    pick: Callable[[list[Any]], tuple[Any, ...]]


class Frames:
    """The frames of one identifier: packs and unpacks them by a table of their signals.

    Args:
        message: of the DBC file.
        identifier: of the frames, see EXTENDED_ID.
        fields: the signals that mean something, by the field of ``kind``.
        factors: of the fields with a physical value, from the file's unit to SI units.
        values: of the fields that say something the raw value of each meaning.
        kind: what :meth:`unpack` returns, and :meth:`pack` takes; None: a plain tuple of ``fields``.
        alive_modulus: of the field ``alive``.
        crc: of these frames.
        no_fault: the board's code of no fault.

    Attributes:
        spans: least and largest value in SI units, by each field in ``factors``.
        every: number of samples from one frame to the next.
        alive_modulus: of the count of the frames, 1 without.
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
        alive_modulus: int = 0,
        crc: Crc | None = None,
        no_fault: int = 0,
    ) -> None:
        self.message, self.identifier, self.fields = message, identifier, fields
        self.factors, self.values, self.crc = factors or {}, values or {}, crc
        self.name, self.size, self.fd = message.name, message.length, is_fd(message)
        self.alive_modulus = alive_modulus or 1
        self.period = (message.cycle_time or 0) * 1e-3
        self.spans = {field: self._span(field) for field in self.factors}
        self.kind, order = kind or tuple, kind._fields if kind else list(fields)
        orders = {byte_order(signal) for signal in message.signals}
        self._order = "big" if orders == {"big"} else "little"
        # Bits of a signal of the other order are counted behind those of the payload, in the payload turned round.
        self._behind = 8 * self.size if len(orders) > 1 else 0
        self.pages = pages(message, fields.values())
        self._order_of_fields, self._no_fault = list(order), no_fault
        self._chains = {
            field: [
                (self._shift(one), (1 << one.length) - 1, 1 << one.length - 1 if one.is_signed else 0, ids)
                for one, ids in selectors(message, signal)
            ]
            for field, signal in fields.items()
        }
        self._page_tables: dict[tuple[str, ...], _Table] = {}
        self._whole_table = None if any(self._chains.values()) else self._table(fields)
        self._packings = [self._packing(self._order_of_fields, page) for page in self.pages]

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

    def fits(self, field: str, value: float) -> bool:
        """Whether ``value`` in SI units rounds to one that can be sent; NaN does not."""
        (least, largest), half = self.spans[field], 0.5 * self.step(field)
        return least - half < value < largest + half

    def _span(self, field: str) -> tuple[float, float]:
        signal, factor = self.fields[field], self.factors[field]
        ends = sorted((raw * signal.scale + signal.offset) * factor for raw in limits(signal))
        return ends[0], ends[1]

    def _shift(self, signal: Signal) -> int:
        return shift(signal, self.size) + (self._behind if byte_order(signal) != self._order else 0)

    def _table(self, shown: Collection[str]) -> _Table:
        """The table of the frames that have the fields ``shown``."""
        fields = {field: self.fields[field] for field in self.fields if field in shown}
        at = {field: place for place, field in enumerate(fields)}
        # Behind the values of the fields stand None, for those that the frame does not have, and True.
        good = at.get("good", len(at) if "good" in self.fields else len(at) + 1)
        said: list[tuple[int, Callable[[Any, Any], Any], Any, str]] = []
        code: tuple[int, int] | None = None
        for field in (one for one in ("amplifier", "good", "enable", "reset") if one in at and one in self.values):
            mask = (1 << fields[field].length) - 1
            meanings: dict[Any, Any] = {raw & mask: said for said, raw in self.values[field].items() if raw >= 0}
            other, reason = None, "pattern"
            if field == "good":
                meanings, other = {self.values[field][True] & mask: True}, False
            elif field == "amplifier":
                other, reason = Amplifier.OFF if self.values[field][Amplifier.OFF] < 0 else None, "state"
                if self.values[field][Amplifier.FAULT] < 0:
                    meanings[_BY_CODE], code = Amplifier.FAULT, (at[field], at["fault"])
            said.append((at[field], meanings.get, other, reason))
        spoken = {place for place, *_ in said}
        numbers = []
        for field, signal in fields.items():
            scale, offset = _line(signal, self.factors[field]) if field in self.factors else (1, 0)
            limited = field in ("x", "y") and self.kind is Report and good != len(at) and _is_limited(signal)
            sign = 1 << signal.length - 1 if signal.is_signed and not signal.is_float else 0
            if at[field] not in spoken and (sign or field in self.factors or limited):
                numbers.append((at[field], sign, scale, offset, limits(signal) if limited else None))
        floats = [
            (at[field], one.length // 8, struct.Struct(f"<{FLOATS[one.length]}").unpack)
            for field, one in fields.items()
            if one.is_float
        ]
        counted = [
            (at[field], self.counts(field))
            for field in ("alive", "counter")
            if field in at and self.counts(field) < 2 ** fields[field].length
        ]
        picked = [good if field == "good" else at.get(field, len(at)) for field in self._order_of_fields]
        # Of a single place, itemgetter() makes no tuple.
        pick = operator.itemgetter(*picked) if len(picked) > 1 else lambda values: (values[picked[0]],)
        bits = [(self._shift(signal), (1 << signal.length) - 1) for signal in fields.values()]
        return _Table(bits, floats, counted, code, said, numbers, good, pick)

    def unpack(self, payload: bytes) -> Any:
        """What a frame says; raises FrameError."""
        if len(payload) != self.size:
            raise FrameError("length")
        if self.crc is not None and not self.crc.fits(payload):
            raise FrameError("crc")
        whole = int.from_bytes(payload + payload[::-1] if self._behind else payload, self._order)
        bits, floats, counted, code, said, numbers, good, pick = self._whole_table or self._page_table(whole)
        values: list[Any] = [whole >> place & mask for place, mask in bits]
        for at, size, unpack in floats:
            (values[at],) = unpack(values[at].to_bytes(size, "little"))
        for at, counts in counted:
            if values[at] >= counts:
                raise FrameError("alive")
        values += None, True
        is_within = True
        for at, sign, scale, offset, limited in numbers:
            raw = (values[at] ^ sign) - sign if sign else values[at]
            if limited and not limited[0] <= raw <= limited[1]:
                is_within = False
            values[at] = raw * scale + offset
        if code is not None and values[code[1]] != self._no_fault:
            values[code[0]] = _BY_CODE
        for at, meaning_of, other, reason in said:
            values[at] = meaning_of(values[at], other)
            if values[at] is None:
                raise FrameError(reason)
        if not is_within:
            values[good] = False
        return _NEW(self.kind, pick(values))

    def _page_table(self, whole: int) -> _Table:
        """The table of a frame with multiplexed signals, of which ``whole`` are the bits."""
        shown = tuple(
            field
            for field, chain in self._chains.items()
            if all(((whole >> place & mask) ^ sign) - sign in ids for place, mask, sign, ids in chain)
        )
        if shown not in self._page_tables:
            self._page_tables[shown] = self._table(shown)
        return self._page_tables[shown]

    def _packing(
        self, order: list[str], page: Mapping[str, int]
    ) -> tuple[int, list[Any], list[Any], list[Any], list[Any]]:
        """Tables of :meth:`pack` for one choice of multiplexer pages, which name fields by their places in ``order``.

        What nobody gives a value has the initial value of the DBC file, multiplexers the page.
        """
        by_name = {signal.name: field for field, signal in self.fields.items()}
        fixed, said, whole, scaled, floats = 0, [], [], [], []
        for signal in self.message.signals:
            place, mask, (least, largest) = self._shift(signal), (1 << signal.length) - 1, limits(signal)
            field, shown = by_name.get(signal.name), in_page(self.message, signal, page)
            if field is None or not shown:
                value = page.get(signal.name, signal.raw_initial if shown else 0) or 0
                bits = _float_bits(signal, value) if signal.is_float else int(value) & mask
                fixed |= bits << place
                continue
            at, factor = order.index(field), self.factors.get(field)
            scale, offset = (1, 0) if factor is None else (signal.scale * factor, signal.offset * factor or 0)
            if field in self.values:
                said.append((at, sent_values(self.values[field])))
            if signal.is_float:
                any_value = signal.length == 64 and signal.minimum is None
                limited = None if any_value else (least, largest)
                floats.append((at, scale, offset, limited, signal, place))
            elif factor is None:
                whole.append((at, least, largest, mask, place, field))
            else:
                scaled.append((at, scale, offset, least, largest, mask, place, field))
        return fixed, said, whole, scaled, floats

    def pack(self, values: Sequence[Any], turn: int = 0) -> bytes:
        """Payload of the ``turn``-th frame: the pages of a multiplexed message take turns.

        Raises:
            ValueError: a value does not fit its signal.
        """
        bits, said, whole, scaled, floats = self._packings[turn % len(self._packings)]
        fields = list(values)
        for at, meanings in said:
            fields[at] = meanings[fields[at]]
        for at, least, largest, mask, place, field in whole:
            raw = fields[at]
            if not least <= raw <= largest:
                self._refuse(field, raw)
            bits |= (raw & mask) << place
        for at, scale, offset, least, largest, mask, place, field in scaled:
            # A whole number stays exact; a comparison with NaN is false.
            raw = fields[at] - offset if scale == 1 else (fields[at] - offset) / scale
            if not least - 0.5 < raw < largest + 0.5:
                self._refuse(field, fields[at])
            bits |= (round(raw) & mask) << place
        for at, scale, offset, limited, signal, place in floats:
            raw = fields[at] - offset if scale == 1 else (fields[at] - offset) / scale
            if limited is not None and not limited[0] <= raw <= limited[1]:
                self._refuse(next(field for field, one in self.fields.items() if one is signal), fields[at])
            bits |= _float_bits(signal, raw) << place
        if self._behind:
            turned = (bits >> self._behind).to_bytes(self.size, "big")
            bits = bits & (1 << self._behind) - 1 | int.from_bytes(turned, "little")
        payload = bits.to_bytes(self.size, self._order)
        return payload if self.crc is None else self.crc.sealed(payload)

    def _refuse(self, field: str, value: float) -> NoReturn:
        ends = self.spans[field] if field in self.factors else limits(self.fields[field])
        unit = f" {UNITS[field]}" if field in UNITS else ""
        raise ValueError(
            f"{field} of {value}{unit} does not fit signal '{self.fields[field].name}' of message '{self.name}'; "
            f"allowed: {ends[0]:.9g} to {ends[1]:.9g}{unit}"
        )


def _line(signal: Signal, factor: float) -> tuple[float, float]:
    """Scale and offset from a raw value to SI units; a whole number without them stays one, and -0.0 stays -0.0."""
    scale, offset = signal.scale * factor, signal.offset * factor
    plain = scale == 1 and not offset and not signal.is_float
    return (1, 0) if plain else (scale, offset or -0.0)


def _is_limited(signal: Signal) -> bool:
    least, largest = limits(signal)
    return signal.is_float or largest - least + 1 < 2**signal.length


def _float_bits(signal: Signal, value: float) -> int:
    return int.from_bytes(struct.pack(f"<{FLOATS[signal.length]}", value), "little")


def sent_values(values: Mapping[Any, int]) -> dict[Any, int]:
    """The raw value that says each meaning, also for those that have none of their own (-1).

    For "off" that is any that is free; for "fault", which the fault code says, that for "off".
    """
    free = next(raw for raw in range(len(values) + 1) if raw not in values.values())
    sent = {meaning: raw if raw >= 0 else free for meaning, raw in values.items()}
    return sent | {Amplifier.FAULT: sent[Amplifier.OFF]} if values.get(Amplifier.FAULT, 0) < 0 else sent
