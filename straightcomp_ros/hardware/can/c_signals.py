"""The signals of a message in C: the value of each in a frame of the board, and what the core reads from the host's."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from straightcomp_ros.hardware.can.dbc_file import DbcError, limits
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault
from straightcomp_ros.hardware.can.message_code import Signals, sent_values
from straightcomp_ros.hardware.can.signal_code import in_page

if TYPE_CHECKING:
    from cantools.database.can import Signal

_MOST_COUNTS = 2**32
_SHORT = 31
"""Bits from which on a value may be more than the core's nearest() takes."""
_LARGEST_FLOAT = 3.4028234663852886e38
_FLOATS = {32: "float", 64: "double"}
_KEYWORDS = re.compile(
    "auto|bool|break|case|char|const|continue|default|do|double|else|enum|"
    "extern|false|float|for|goto|if|inline|int|long|register|restrict|return|"
    "short|signed|sizeof|static|struct|switch|true|typedef|union|unsigned|void|volatile|"
    "while"
)


class Number(NamedTuple):
    """C expressions of a physical value in a frame: its raw value, and whether it is within its signal."""

    raw: str
    fits: str


def c_names(names: Iterable[str]) -> dict[str, str]:
    """For each name of a DBC file one in C: in small letters, no keyword, and no two alike."""
    found: dict[str, str] = {}
    for name in names:
        # As cantools writes them, which leaves such names as they are.
        parted = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", re.sub(r"(.)([A-Z][a-z]+)", r"\1_\2", name))
        plain = own = re.sub(r"_+", "_", re.sub(r"[^a-z0-9]", "_", parted.lower()))
        if not re.match("[a-z]", plain):
            plain = own = f"x{plain}"
        number = 1
        while own in found.values() or _KEYWORDS.fullmatch(own):
            number += 1
            own = f"{plain}_{number}"
        found[name] = own
    return found


def refuse_in_c(signals: Signals) -> None:
    """Raise DbcError for a signal that the firmware cannot have."""
    message = signals.message.name
    for signal in signals.message.signals:
        if signal.is_float and signal.length not in _FLOATS:
            raise DbcError(
                f"signal '{signal.name}' of message '{message}' is a float of {signal.length} bits; the firmware has "
                "those of 32 and 64 bits"
            )
        if signal.length > 64:
            raise DbcError(f"signal '{signal.name}' of message '{message}' has more than the firmware's 64 bits")
    for field in ("alive", "counter", "echo"):
        if signals.counts(field) > _MOST_COUNTS:
            name = signals.signals[field].name
            raise DbcError(f"'{name}' of message '{message}' counts beyond 32 bits; the firmware's counts have 32 bits")


def number_in_c(signals: Signals, field: str) -> Number:
    """The current, or the reading x or y."""
    signal, factor = signals.signals[field], signals.factors[field]
    scale, offset = signal.scale * factor, signal.offset * factor
    if field != "current" and not signal.is_float and not offset:
        counts = f"scaled(report->scaling->{field}, report->{field})"
        least, largest = (_whole(end) for end in limits(signal))
        within = f"limited({counts}, {least}, {largest})"
        return Number(_typed(signal, within), f"({within} == {counts})")
    value = "report->current"
    if field != "current":
        value = f"((board_real)report->{field} * report->scaling->{field}_count)"
    least, largest = (_real(end) for end in signals.span(field))
    raw = f"limited_real({value}, {least}, {largest})"
    if offset:
        raw = f"({raw} - {_real(offset)})"
    if scale != 1:
        raw = f"({raw} / {_real(scale)})"
    if not signal.is_float:
        raw = f"nearest{'' if signal.length < _SHORT else '_of_many'}({raw})"
    return Number(_typed(signal, raw), f"(({value} >= {least}) && ({value} <= {largest}))")


def packed(signals: Signals, page: Mapping[str, int], known: Mapping[str, str]) -> dict[str, str]:
    """Values of the members of cantools' struct in C, for one page of a multiplexed message.

    ``known`` has the expressions of fields that the board's report does not have.
    """
    message, own = signals.message, c_names(signal.name for signal in signals.message.signals)
    fields = {signal.name: field for field, signal in signals.signals.items()}
    values = {}
    for signal in message.signals:
        if signal.name in fields and in_page(message, signal, page):
            values[own[signal.name]] = _value(signals, fields[signal.name], known)
        elif signal.name in page:
            values[own[signal.name]] = _typed(signal, f"{page[signal.name]}")
        elif signal.raw_initial and in_page(message, signal, page):
            initial = _real(signal.raw_initial) if signal.is_float else _whole(signal.raw_initial)
            values[own[signal.name]] = _typed(signal, initial)
    # A struct needs a first value.
    return values or {next(iter(own.values())): "0"}


def _value(signals: Signals, field: str, known: Mapping[str, str]) -> str:
    signal = signals.signals[field]
    if field in signals.factors:
        return number_in_c(signals, field).raw
    if field in known:
        return _typed(signal, known[field])
    if field == "amplifier":
        raw = sent_values(signals.values[field])
        states = ", ".join(f"{raw[state]}u" for state in (Amplifier.OFF, Amplifier.OFF, Amplifier.ON, Amplifier.FAULT))
        return _typed(signal, f"((const uint32_t[]){{{states}}})[report->amplifier]")
    if field == "good":
        values = signals.values[field]
        return _typed(signal, f"(report->good ? {values[True]} : {values[False]})")
    return _typed(signal, f"report->{field}")


def fault_in_c(codes: Mapping[BoardFault, int]) -> str:
    """Expression of the board's own code of a fault."""
    table = ", ".join(f"{codes[fault]}u" for fault in BoardFault)
    return f"((const uint32_t[]){{{table}}})[report->fault]"


def unpacked(signals: Signals) -> tuple[list[str], list[str]]:
    """Statements that read a command from cantools' struct ``frame``, and the conditions under which it is one."""
    own = c_names(signal.name for signal in signals.message.signals)
    statements, tests = [], []
    for field, signal in signals.signals.items():
        raw = f"frame.{own[signal.name]}"
        if field in ("alive", "echo"):
            statements.append(f"command->{field} = (uint32_t){raw};")
            if field == "alive" and signals.counts(field) < 2**signal.length:
                tests.append(f"({raw} < {signals.counts(field)}u)")
        elif field in ("enable", "reset"):
            no, yes = (_typed(signal, f"{signals.values[field][said]}") for said in (False, True))
            statements.append(f"command->{field} = {raw} == {yes};")
            tests.append(f"(({raw} == {no}) || ({raw} == {yes}))")
        else:
            scale, offset = (part * signals.factors[field] for part in (signal.scale, signal.offset))
            value = f"(board_real){raw}" + (f" * {_real(scale)}" if scale != 1 else "")
            statements.append(f"command->{field} = {value}" + (f" + {_real(offset)};" if offset else ";"))
        statements.append(f"command->given |= (uint8_t)COMMAND_{field.upper()};")
    return statements, tests


def _typed(signal: Signal, expression: str) -> str:
    if signal.is_float:
        return f"({_FLOATS[signal.length]}){expression}"
    width = next(width for width in (8, 16, 32, 64) if signal.length <= width)
    return f"({'' if signal.is_signed else 'u'}int{width}_t){expression}"


def _whole(number: float) -> str:
    # What is beyond is no position in counts.
    within = min(max(int(number), -(2**63) + 1), 2**63 - 1)
    return f"INT64_C({within})"


def _real(number: float) -> str:
    return f"(board_real){min(max(float(number), -_LARGEST_FLOAT), _LARGEST_FLOAT)!r}"
