"""Code that takes signals out of a payload and puts them into one, generated once from a message of a DBC file.

A signal that fills bytes in a size that the processor has is read by struct, any other by shifting and masking the
whole payload as one integer. Bits are numbered as in a DBC file: a signal of Intel order starts at its lowest bit, one
of Motorola order at its highest, and bit 0 of each byte is the byte's lowest.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from straightcomp_ros.hardware.can.dbc_file import DbcError, limits

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_INTEGER = {8: "b", 16: "h", 32: "i", 64: "q"}
_FLOAT = {16: "e", 32: "f", 64: "d"}
_ORDERS: Mapping[str, tuple[str, Literal["little", "big"]]] = {
    "little_endian": ("<", "little"),
    "big_endian": (">", "big"),
}


def byte_order(signal: Signal) -> Literal["little", "big"]:
    """Byte order of the signal, as int.from_bytes takes it."""
    return _ORDERS[signal.byte_order][1]


def shift(signal: Signal, size: int) -> int:
    """Bits right of the signal, in the payload of ``size`` bytes read as one integer of the signal's byte order."""
    if signal.byte_order == "little_endian":
        return signal.start
    return 8 * size - 8 * (signal.start // 8) - 7 + signal.start % 8 - signal.length


def refuse_signal(message: Message, signal: Signal) -> None:
    """Raise DbcError for a signal that cannot be used: its place, its factor, or its limits."""
    place = f"'{signal.name}' of message '{message.name}'"
    if not _fits(message, signal):
        raise DbcError(f"{place} does not lie within the {message.length} bytes of its message")
    if signal.is_float and signal.length not in _FLOAT:
        raise DbcError(f"{place} is a float of {signal.length} bits; allowed: 16, 32 or 64")
    numbers = (signal.scale, signal.offset, signal.minimum or 0, signal.maximum or 0)
    if signal.scale == 0 or not all(map(math.isfinite, numbers)):
        raise DbcError(f"{place} has a factor of {signal.scale}; allowed: finite numbers, and a factor other than 0")
    least, largest = limits(signal)
    if least > largest:
        held = sorted(raw * signal.scale + signal.offset for raw in limits(signal, narrowed=False))
        raise DbcError(
            f"{place} has limits of {signal.minimum:.9g} to {signal.maximum:.9g}, of which its bits hold none; they "
            f"hold {held[0]:.9g} to {held[1]:.9g}"
        )


def used_part(message: Message, used: Sequence[Signal]) -> Message:
    """The message with the signals ``used``, their multiplexers, and what else has an initial value in their frames.

    Raises:
        DbcError: two of the signals lie on each other, or one chooses the page of another.
    """
    from cantools.database.can import Message as CanMessage

    chosen = {signal.name: signal for signal in used}
    for signal in used:
        for selector, _ in selectors(message, signal):
            if selector.name in {one.name for one in used}:
                raise DbcError(
                    f"'{selector.name}' of message '{message.name}' chooses the frames that have '{signal.name}'; "
                    "allowed: a multiplexer without another meaning"
                )
            chosen.setdefault(selector.name, selector)
    for one, other in itertools.combinations(chosen.values(), 2):
        if _overlap(message, one, other):
            raise DbcError(f"'{one.name}' and '{other.name}' of message '{message.name}' lie on each other")
    for signal in message.signals:
        shown = all(selector.name in chosen for selector, _ in selectors(message, signal))
        free = _fits(message, signal) and not any(_overlap(message, signal, one) for one in chosen.values())
        if signal.raw_initial and shown and free:
            chosen.setdefault(signal.name, signal)
    return CanMessage(
        message.frame_id,
        message.name,
        message.length,
        [signal for signal in message.signals if chosen.get(signal.name) is signal],
        cycle_time=message.cycle_time,
        is_extended_frame=message.is_extended_frame,
        is_fd=message.is_fd,
    )


def _fits(message: Message, signal: Signal) -> bool:
    return signal.length > 0 and 0 <= shift(signal, message.length) <= 8 * message.length - signal.length


def _overlap(message: Message, one: Signal, other: Signal) -> bool:
    """Whether two signals have a bit in common in some frame."""
    pages = dict((selector.name, ids) for selector, ids in selectors(message, one))
    for selector, ids in selectors(message, other):
        if not set(pages.get(selector.name, ids)) & set(ids):
            return False
    return bool(_bits(message, one) & _bits(message, other))


def _bits(message: Message, signal: Signal) -> int:
    """The signal's bits in the payload, as an integer of Intel order."""
    bits: int = (2**signal.length - 1) << shift(signal, message.length)
    return int.from_bytes(bits.to_bytes(message.length, byte_order(signal)), "little")


def raw_expression(signal: Signal, size: int, whole: str) -> str:
    """Python expression of the raw value in ``whole``, the payload as an integer of the signal's byte order."""
    bits = f"({whole} >> {shift(signal, size)} & {2**signal.length - 1})"
    if signal.is_float:
        name = byte_order(signal)
        return f"unpack_{signal.length}{name}({bits}.to_bytes({signal.length // 8}, '{name}'))[0]"
    if signal.is_signed:
        half = 2 ** (signal.length - 1)
        return f"(({bits} ^ {half}) - {half})"
    return bits


class Reading:
    """Code that reads ``signals`` of ``message`` from ``payload``.

    Attributes:
        lines: to run first.
        raw: for each signal by name the expression of its raw value; of a multiplexed one, if its page is there.
        shown: for each signal by name the condition under which it is there; empty for always.
        names: what the code refers to.
    """

    def __init__(self, message: Message, signals: Sequence[Signal]) -> None:
        self.lines: list[str] = []
        self.raw: dict[str, str] = {}
        self.names: dict[str, Any] = {"from_bytes": int.from_bytes}
        self._message = message
        chosen = {signal.name: signal for signal in signals}
        for signal in signals:
            for selector, _ in selectors(message, signal):
                chosen.setdefault(selector.name, selector)
        for order in _ORDERS:
            self._read_aligned([signal for signal in chosen.values() if signal.byte_order == order], order)
        for signal in chosen.values():
            if signal.name not in self.raw:
                self._shift_out(signal)
        self.shown = {signal.name: self._condition(signal) for signal in signals}

    def _read_aligned(self, signals: Sequence[Signal], order: str) -> None:
        """Read what fills whole bytes of a size that struct knows by a single struct, as far as nothing overlaps."""
        sign, name = _ORDERS[order]
        code, end = sign, 0
        taken = []
        for signal in sorted(filter(_aligned, signals), key=lambda signal: signal.start):
            begin = signal.start // 8
            if begin >= end:
                letter = _FLOAT[signal.length] if signal.is_float else _INTEGER[signal.length]
                code += f"{begin - end}x" + (letter if signal.is_float or signal.is_signed else letter.upper())
                end = begin + signal.length // 8
                taken.append(signal.name)
        if taken:
            layout = struct.Struct(f"{code}{self._message.length - end}x")
            self.names[f"unpack_{name}"] = layout.unpack
            self.raw |= {one: f"{name}_{index}" for index, one in enumerate(taken)}
            self.lines.append(f"{', '.join(self.raw[one] for one in taken)}, = unpack_{name}(payload)")

    def _shift_out(self, signal: Signal) -> None:
        sign, name = _ORDERS[signal.byte_order]
        line = f"{name} = from_bytes(payload, '{name}')"
        if line not in self.lines:
            self.lines.append(line)
        if signal.is_float:
            self.names[f"unpack_{signal.length}{name}"] = struct.Struct(sign + _FLOAT[signal.length]).unpack
        self.raw[signal.name] = raw_expression(signal, self._message.length, name)

    def _condition(self, signal: Signal) -> str:
        tests = []
        for selector, pages in selectors(self._message, signal):
            value = self.raw[selector.name]
            tests.append(f"{value} == {pages[0]}" if len(pages) == 1 else f"{value} in {tuple(pages)}")
        return " and ".join(tests)

    def expression(self, signal: Signal, value: str) -> str:
        """``value``, an expression with the raw value of the signal; None where the signal is not in the frame."""
        condition = self.shown[signal.name]
        return f"({value} if {condition} else None)" if condition else value


def physical(signal: Signal, raw: str, factor: float = 1.0) -> str:
    """Expression of the physical value times ``factor``, from the expression ``raw``."""
    scale, offset = signal.scale * factor, signal.offset * factor
    scaled = raw if scale == 1 else f"{raw} * {scale!r}"
    return f"{scaled} + {offset!r}" if offset else scaled


class Writing:
    """Code that puts ``signals`` of ``message`` into ``payload``; all others get their initial values.

    ``values`` names for each signal the variable that holds its value: a raw one, or with a factor in ``factors`` a
    physical one times this factor. ``selected`` gives the pages of the multiplexers. The code calls ``refuse(name,
    value)`` for a value that does not fit the signal.
    """

    def __init__(
        self,
        message: Message,
        values: Mapping[str, str],
        factors: Mapping[str, float],
        selected: Mapping[str, int],
    ) -> None:
        self.names: dict[str, Any] = {"from_bytes": int.from_bytes}
        self.lines: list[str] = []
        size = message.length
        words: dict[str, list[str]] = {"little": [], "big": []}
        fixed = {"little": 0, "big": 0}
        for signal in message.signals:
            sign, name = _ORDERS[signal.byte_order]
            place = shift(signal, size)
            if signal.name in values:
                bits = self._checked(signal, values[signal.name], factors.get(signal.name), sign, name)
                words[name].append(f"({bits}) << {place}" if place else bits)
            elif signal.name in selected or in_page(message, signal, selected):
                fixed[name] |= _initial(signal, selected.get(signal.name), sign, name) << place
        terms = {name: " | ".join([*words[name], str(fixed[name])]) for name in words}
        order = "little" if words["little"] else "big"
        other = "big" if order == "little" else "little"
        if words[other] or fixed[other]:
            terms[order] += f" | from_bytes(({terms[other]}).to_bytes({size}, '{other}'), '{order}')"
        self.lines.append(f"payload = ({terms[order]}).to_bytes({size}, '{order}')")

    def _checked(self, signal: Signal, value: str, factor: float | None, sign: str, order: str) -> str:
        """Lines that make the raw value of ``value`` and check it; returns the expression of its bits."""
        raw = f"raw_{value}"
        least, largest = limits(signal)
        if factor is None:
            self.lines.append(f"{raw} = {value}")
        else:
            scale, offset = signal.scale * factor, signal.offset * factor
            number = f"({value} - {offset!r})" if offset else value
            self.lines.append(f"{raw} = {number}" if scale == 1 else f"{raw} = {number} / {scale!r}")
        if signal.is_float:
            if signal.length < 64 or signal.minimum is not None:
                # A comparison with NaN is false.
                self.lines.append(f"if not {least!r} <= {raw} <= {largest!r}: refuse({signal.name!r}, {value})")
            self.names[f"pack_{signal.length}{order}"] = struct.Struct(sign + _FLOAT[signal.length]).pack
            return f"from_bytes(pack_{signal.length}{order}({raw}), '{order}')"
        if factor is None:
            self.lines.append(f"if not {least} <= {raw} <= {largest}: refuse({signal.name!r}, {value})")
        else:
            self.lines.append(f"if not {least} - 0.5 < {raw} < {largest} + 0.5: refuse({signal.name!r}, {value})")
            self.lines.append(f"{raw} = round({raw})")
        return f"{raw} & {2**signal.length - 1}" if signal.is_signed else raw


def _initial(signal: Signal, selected: int | None, sign: str, order: Literal["little", "big"]) -> int:
    """Bits of a signal that nobody gives a value: the page that it selects, or its initial value in the file."""
    value: float = (signal.raw_initial or 0) if selected is None else selected
    if signal.is_float:
        return int.from_bytes(struct.pack(sign + _FLOAT[signal.length], value), order)
    bits: int = int(value) & 2**signal.length - 1
    return bits


def selectors(message: Message, signal: Signal) -> list[tuple[Signal, list[int]]]:
    """The multiplexers under which the signal lies, outermost first, each with the pages that have it."""
    found: list[tuple[Signal, list[int]]] = []
    while signal.multiplexer_signal and signal.multiplexer_ids is not None:
        selector = next((one for one in message.signals if one.name == signal.multiplexer_signal), None)
        if selector is None or any(selector is one for one, _ in found):
            raise DbcError(f"'{signal.name}' of message '{message.name}' has no multiplexer that it can be found by")
        found.insert(0, (selector, sorted(signal.multiplexer_ids)))
        signal = selector
    return found


def pages(message: Message, signals: Sequence[Signal]) -> list[dict[str, int]]:
    """The fewest choices of multiplexer pages that show all ``signals``; one empty choice for a message without."""
    found: list[dict[str, int]] = [{}]
    for signal in signals:
        wanted = {selector.name: ids[0] for selector, ids in selectors(message, signal)}
        if any(in_page(message, signal, page) for page in found):
            continue
        if found == [{}]:
            found = []
        found.append(wanted)
    return found


def in_page(message: Message, signal: Signal, selected: Mapping[str, int]) -> bool:
    """Whether the multiplexer pages ``selected`` show the signal."""
    return all(selected.get(selector.name) in ids for selector, ids in selectors(message, signal))


def compiled(name: str, head: str, lines: Sequence[str], names: Mapping[str, Any]) -> Callable[..., Any]:
    """The function ``name``, of the parameters ``head`` and the body ``lines``, which refers to ``names``."""
    source = f"def {name}({head}):\n" + "".join(f"    {line}\n" for line in lines)
    space = dict(names)
    exec(compile(source, f"<{name}>", "exec"), space)
    function: Callable[..., Any] = space[name]
    return function


def _aligned(signal: Signal) -> bool:
    whole = _FLOAT if signal.is_float else _INTEGER
    first = 0 if signal.byte_order == "little_endian" else 7
    return signal.length in whole and signal.start % 8 == first
