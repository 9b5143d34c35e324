"""Reads a DBC file by cantools: the messages of a bus, where their signals lie, and which of them can be used.

Bits are numbered as in a DBC file: a signal of Intel order starts at its lowest bit, one of Motorola order at its
highest, and bit 0 of each byte is the byte's lowest.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from straightcomp_ros.parameters.declaration import instead
from straightcomp_ros.parameters.share import named_file
from straightcomp_ros.parameters.yaml_text import bounded_bytes, marked_encoding

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

EXTENDED_ID = 1 << 31
"""Set in an identifier of 29 bits, as in DBC files and in Linux's frames."""
_LARGEST = {False: 0x7FF, True: 0x1FFFFFFF}
_FD_SIZES = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Bytes of a frame of CAN FD."""
FLOATS = {32: "f", 64: "d"}
"""struct's letters by the bits of a float."""
_FLOAT_SIZES = {"1": "32", "2": "64"}
"""Bits by the number of SIG_VALTYPE_."""
LARGEST_FLOAT = {32: (2 - 2.0**-23) * 2.0**127, 64: sys.float_info.max}
_WHOLE = {
    "VERSION": r'VERSION\s*"',
    "NS_": r"(?!)",
    "BS_": r"BS_\s*:",
    "BU_": r"BU_\s*:",
    "BO_": r"BO_\s+\d+\s+\w+\s*:\s*\d+\s+\w",
    "SG_": r'SG_\s+(\w+)[^"]*"[^"]*"\s*\w',
}
"""How the statements that no semicolon ends are when they are whole. The list of NS_ ends where another begins."""
_BEGIN = r"[ \t]*\b(VERSION|FILTER|[A-Z]+(?:_[A-Z]+)*_)\b(?![ \t]*\r?$)"
_LAST = rf"\s*;\s*(?:^{_BEGIN}|\Z)"
"""Behind a quote that closes a text, also behind a backslash: the path of a folder may end in one."""
_TEXT = rf'"(?!{_LAST})(?:\\"(?!{_LAST})|[^"])*"'
_STATEMENT = re.compile(rf'(?:^|(?<=;)){_BEGIN}(?:{_TEXT}|//[^\n]*|[^"\n/;]+|/|\n(?!{_BEGIN}))*;?', re.MULTILINE)
_MESSAGE = re.compile(r"BO_\s+(\d+)\s+(\w+)")
_DEFINITION = re.compile(r'BA_DEF_(?:DEF_)?\s+(?:BO_\s+|SG_\s+)?"([^"]*)"')
_ABOUT = re.compile(r'(?:BA_\s+"([^"]*)"\s+(?:BO_|SG_)|VAL_|SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+)(?:\s+(\w+))?')
"""Statements on a message: attribute if it is one, number of the message, signal."""
_LONG_NAME = "SystemMessageLongSymbol"
_READ = {"GenMsgCycleTime", "GenSigStartValue", "VFrameFormat", "SystemSignalLongSymbol", _LONG_NAME}
"""Attributes that mean something to the driver."""
_MOST_PAGES, _LONGEST_CYCLE_MS = 1 << 20, 1e9
_TOO_LARGE = re.compile(
    r"\b\d{1000,}|\b\d+\.?\d*[eE][-+]?\d{4,}"
    r"|^(?:BO_|SG_)\b[^:]*:[^(]*?(?<!\w)\d{5,}",
    re.DOTALL,
)
"""Numbers of any kind, sizes and places of messages and signals."""
_WORDS = re.compile(r'"(?:\\"|[^"])*"|//.*')
"""Texts and comments in a statement."""
_LEAST_FACTOR, _LARGEST_FACTOR = 1e-18, 1e18
"""Beyond them a value in SI units may be 0 or infinite, or a factor be 0 in the 32 bits of a firmware's numbers."""


class DbcError(ValueError):
    """A DBC file cannot be read, or lacks what is asked of it; the message names file, message, signal and rule."""


class Dbc:
    """A DBC file.

    Args:
        file: its name; one that does not exist is looked for among the package's own, as ``config/straightcomp.dbc``.

    Raises:
        DbcError: the file cannot be read.
    """

    def __init__(self, file: str) -> None:
        self.file, self.path = file, _found(file)
        self._messages: dict[str, Message] = {}
        self._statements: dict[tuple[str, str], list[str]] = {}
        """By number and name those of each message itself, and of its signals."""
        self._known: dict[str, list[tuple[str, str]]] = {}
        """By name, in the file the short one or a long one, number and short name of each message."""
        self._definitions, self._about, own = list[str](), list[tuple[str | None, str, str, str]](), list[str]()
        for keyword, text in _statements(_text(self.path), self.path):
            if named := _MESSAGE.match(text):
                own = self._statements[named[1], named[2]] = []
                self._known.setdefault(named[2], []).append((named[1], named[2]))
            if keyword in ("BO_", "SG_"):
                own.append(text)
            elif (defined := _DEFINITION.match(text)) and defined[1] in _READ:
                self._definitions.append(text)
            elif about := _ABOUT.match(text):
                self._about.append((about[1], about[2], about[3], text))
        if not self._statements:
            raise DbcError(f"'{self.path}' is no valid DBC file: it has no message (BO_)")
        for attribute, number, _, text in self._about:
            if attribute == _LONG_NAME:
                name = text.split('"')[3]
                found = [pair for pair in self._statements if pair[0] == number and pair[1] != name]
                self._known.setdefault(name, []).extend(found)

    def message(self, name: str) -> Message:
        """The message ``name``, if it can be sent as one frame. Nothing else in the file is looked at.

        Raises:
            DbcError: there is none or more than one, it cannot be read, or no frame has its length.
        """
        if name not in self._messages:
            self._messages[name] = self._read(name)
        return self._messages[name]

    def _read(self, name: str) -> Message:
        # Half a second, which only a driver with a bus needs.
        import cantools

        found = self._known.get(name)
        if not found:
            raise DbcError(f"'{name}' is not a message of {self.file}{instead(name, self._known)}")
        if len(found) > 1:
            identifiers = " and ".join(f"{int(number) & ~EXTENDED_ID:#x}" for number, _ in found)
            raise DbcError(f"message '{name}' is in {self.file} {len(found)} times, as {identifiers}; allowed: once")
        try:
            statements = self._of(*found[0])
            _refuse_sizes(statements)
            database = cantools.database.load_string("\n".join(statements), "dbc", strict=False)
            assert isinstance(database, cantools.database.can.Database)
            (message,) = database.messages
        except (cantools.Error, ValueError, LookupError, TypeError, ArithmeticError, AssertionError) as error:
            reason = " ".join(str(error).split())
            raise DbcError(f"message '{name}' of {self.file} cannot be read: {reason}") from None
        sizes = _FD_SIZES if is_fd(message) else _FD_SIZES[:9]
        if message.length not in sizes:
            raise DbcError(
                f"message '{name}' of {self.file} has {message.length} bytes; allowed: {', '.join(map(str, sizes))}"
            )
        return message

    def _of(self, number: str, short: str) -> list[str]:
        """The statements of one message. Those of signals that are gone have been left over."""
        own = self._statements[number, short]
        signals = {found[1] for text in own if (found := re.match(_WHOLE["SG_"], text))}
        about = [(attribute, word, text) for attribute, of, word, text in self._about if of == number]
        of_signals = [text for attribute, word, text in about if attribute is None and word in signals]
        defined = {text.split('"')[1] for text in self._definitions}
        return [*own, *self._definitions, *of_signals, *(text for attribute, _, text in about if attribute in defined)]

    def signal(self, message: Message, name: str) -> Signal:
        """The signal ``name`` of a message of this file; DbcError if there is none."""
        found = [signal for signal in message.signals if signal.name == name]
        if len(found) > 1:
            raise DbcError(f"'{name}' is {len(found)} signals of message '{message.name}' of {self.file}; allowed: one")
        if found:
            # cantools takes any byte order but 0 for Intel's, and any length of a float.
            text = "\n".join(self._of(*self._known[message.name][0]))
            place = re.search(rf"SG_\s+{re.escape(name)}\b[^|]*\|(\d+)@(\d+)", text)
            kind = (re.findall(rf"SIG_VALTYPE_\s+\d+\s+{re.escape(name)}\s*:\s*(\d+)", text) or ["0"])[0]
            if place and (place[2] not in ("0", "1") or (kind != "0" and place[1] != _FLOAT_SIZES.get(kind))):
                raise DbcError(
                    f"'{name}' of message '{message.name}' of {self.file} has {place[1]} bits, byte order @{place[2]}, "
                    f"SIG_VALTYPE_ {kind}; allowed: @0 or @1, and 32 bits with SIG_VALTYPE_ 1, 64 bits with 2"
                )
            return found[0]
        known = [signal.name for signal in message.signals]
        raise DbcError(f"'{name}' is not a signal of message '{message.name}' of {self.file}{instead(name, known)}")

    def identifier(self, message: Message, node: int) -> int:
        """CAN identifier for ``node``: that in the file is node 1's. EXTENDED_ID is set in one of 29 bits."""
        identifier, extended = message.frame_id + node - 1, message.is_extended_frame
        if identifier > _LARGEST[extended]:
            raise DbcError(
                f"{node} moves message '{message.name}' of {self.file} from identifier {message.frame_id:#x} to "
                f"{identifier:#x}; allowed: <= {_LARGEST[extended]:#x}"
            )
        return identifier | EXTENDED_ID if extended else identifier


def _refuse_sizes(statements: Iterable[str]) -> None:
    """Raise ValueError for a number in the statements of a message that would fill the memory: cantools writes a letter
    for each bit of a message, and a table for each page of a multiplexer."""
    pages = 0
    for text in statements:
        plain = _WORDS.sub("", text)
        if found := _TOO_LARGE.search(plain):
            raise ValueError(f"…{found[0][-20:]} in {text.split(maxsplit=1)[0]}; allowed: less than 10000 bits")
        if plain.startswith("SG_MUL_VAL_"):
            pages += sum(max(0, int(last) - int(first)) for first, last in re.findall(r"(\d+)\s*-(\d+)", plain))
            if pages > _MOST_PAGES:
                raise ValueError(f"more than {_MOST_PAGES} pages in SG_MUL_VAL_; allowed: no more in a message")


def is_fd(message: Message) -> bool:
    """Whether the message is a frame of CAN FD: the file says so, or it is too long for another."""
    return message.is_fd or message.length > 8


def limits(signal: Signal, *, narrowed: bool = True) -> tuple[float, float]:
    """Least and largest raw value: what the signal's bits can hold, ``narrowed`` by the file's minimum and maximum."""
    if signal.is_float:
        least, largest = -LARGEST_FLOAT[signal.length], LARGEST_FLOAT[signal.length]
    elif signal.is_signed:
        least, largest = -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
    else:
        least, largest = 0, 2**signal.length - 1
    if not narrowed or signal.minimum is None or signal.maximum is None or signal.minimum >= signal.maximum:
        return least, largest  # [0|0] says nothing
    ends = sorted((float(end) - signal.offset) / signal.scale for end in (signal.minimum, signal.maximum))
    if signal.is_float:
        return max(least, ends[0]), min(largest, ends[1])
    # Of an end far beyond the bits, infinity perhaps, it counts that it is beyond.
    lower, upper = (round(min(max(end, least - 1), largest + 1)) for end in ends)
    return max(least, lower), min(largest, upper)


def modulus(signal: Signal) -> int:
    """Of a counter: one more than its largest raw value."""
    return int(limits(signal)[1]) + 1


def byte_order(signal: Signal) -> Literal["little", "big"]:
    """Byte order of the signal, as int.from_bytes takes it."""
    return "little" if signal.byte_order == "little_endian" else "big"


def shift(signal: Signal, size: int) -> int:
    """Bits right of the signal, in the payload of ``size`` bytes read as one integer of the signal's byte order."""
    if byte_order(signal) == "little":
        return signal.start
    return 8 * size - 8 * (signal.start // 8) - 7 + signal.start % 8 - signal.length


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


def pages(message: Message, signals: Iterable[Signal]) -> list[dict[str, int]]:
    """The fewest choices of multiplexer pages that show all ``signals``; one empty choice for a message without."""
    found: list[dict[str, int]] = []
    for signal in signals:
        wanted = {selector.name: ids[0] for selector, ids in selectors(message, signal)}
        if wanted and not any(in_page(message, signal, page) for page in found):
            found.append(wanted)
    return found or [{}]


def in_page(message: Message, signal: Signal, selected: Mapping[str, int]) -> bool:
    """Whether the multiplexer pages ``selected`` show the signal."""
    return all(selected.get(selector.name) in ids for selector, ids in selectors(message, signal))


def refuse_signal(message: Message, signal: Signal) -> None:
    """Raise DbcError for a signal that cannot be used: its place, its factor, its limits, or its multiplexers."""
    place = f"'{signal.name}' of message '{message.name}'"
    if not 0 < signal.length <= 8 * message.length - shift(signal, message.length) <= 8 * message.length:
        raise DbcError(f"{place} does not lie within the {message.length} bytes of its message")
    if signal.is_float and signal.length not in FLOATS:
        raise DbcError(f"{place} is a float of {signal.length} bits; allowed: 32 or 64")
    for what, written, smallest, greatest in (
        ("factor", signal.scale, _LEAST_FACTOR, _LARGEST_FACTOR),
        ("offset", signal.offset, 0.0, _LARGEST_FACTOR),
        ("minimum", signal.minimum or 0, 0.0, sys.float_info.max),
        ("maximum", signal.maximum or 0, 0.0, sys.float_info.max),
    ):
        # A whole number may have more digits than a float holds.
        number = float(str(written))
        if not smallest <= abs(number) <= greatest:
            raise DbcError(f"{place} has a {what} of {number:g}; allowed: {smallest:g} to {greatest:g}, of either sign")
    least, largest = limits(signal)
    if least > largest:
        held = sorted(raw * signal.scale + signal.offset for raw in limits(signal, narrowed=False))
        raise DbcError(
            f"{place} has limits of {signal.minimum:.9g} to {signal.maximum:.9g}, of which its bits hold none; they "
            f"hold {held[0]:.9g} to {held[1]:.9g}"
        )
    for selector, ids in selectors(message, signal):
        refuse_signal(message, selector)
        if selector.is_float:
            raise DbcError(f"{place} has the multiplexer '{selector.name}', a float; allowed: an integer")
        least, largest = limits(selector, narrowed=False)
        for beyond in (one for one in ids if not least <= one <= largest):
            raise DbcError(
                f"{place} is on page {beyond} of multiplexer '{selector.name}'; allowed: {least} to {largest}"
            )


def used_signals(message: Message, used: Sequence[Signal]) -> Message:
    """The message with the signals ``used``, their multiplexers, and what else has an initial value in their frames.

    Raises:
        DbcError: two of the signals lie on each other, one chooses the page of another, or the cycle time is no number.
    """
    import cantools

    cycle = message.cycle_time
    if not isinstance(cycle, int | float | None) or abs(cycle or 0) > _LONGEST_CYCLE_MS:
        raise DbcError(
            f"message '{message.name}' has a cycle time of {cycle!r:.20}; allowed: a number of ms, "
            f"<= {_LONGEST_CYCLE_MS:g}"
        )
    chosen = {signal.name: signal for signal in used}
    names = set(chosen)
    for signal in used:
        for selector, _ in selectors(message, signal):
            if selector.name in names:
                raise DbcError(
                    f"'{selector.name}' of message '{message.name}' chooses the frames that have '{signal.name}'; "
                    "allowed: a multiplexer without another meaning"
                )
            chosen.setdefault(selector.name, selector)

    def made(chosen: Mapping[str, Signal]) -> Message:
        return cantools.database.can.Message(
            message.frame_id,
            message.name,
            message.length,
            [signal for signal in message.signals if chosen.get(signal.name) is signal],
            cycle_time=message.cycle_time,
            is_extended_frame=message.is_extended_frame,
            is_fd=message.is_fd,
            strict=True,
        )

    try:
        found = made(chosen)
    except cantools.Error as error:
        raise DbcError(f"two signals lie on each other: {error}") from None
    for signal in message.signals:
        shown = all(selector.name in chosen for selector, _ in selectors(message, signal))
        usable = not signal.is_float or signal.length in FLOATS
        if usable and _has_initial(signal) and shown and signal.name not in chosen:
            # One that lies on others, or beyond the message, is left out.
            with contextlib.suppress(cantools.Error):
                found, chosen = made(chosen | {signal.name: signal}), chosen | {signal.name: signal}
    return found


def _has_initial(signal: Signal) -> bool:
    """Whether the signal begins with another value than 0 that its bits can hold."""
    raw, (least, largest) = signal.raw_initial or 0, limits(signal, narrowed=False)
    return raw != 0 and least <= raw <= largest and (signal.is_float or raw == int(raw))


def _found(file: str) -> Path:
    path = named_file(file)
    if not os.path.exists(path):
        raise DbcError(f"'{file}': No such file; name a DBC file")
    return path.absolute()  # it is read later, perhaps from another folder


def _text(path: Path) -> str:
    try:
        return decoded(bounded_bytes(path)).replace("\r\n", "\n").replace("\r", "\n")
    except OSError as error:
        raise DbcError(f"'{path}': {error.strerror}") from None


def decoded(content: bytes) -> str:
    """Text in UTF-8, in UTF-16 with its mark, or as Vector's tools write it in Europe; of other languages the ASCII."""
    try:
        return content.decode(marked_encoding(content) or "utf-8")
    except UnicodeDecodeError:
        # In Shift-JIS and GBK a backslash is the second byte of some characters: it does not escape what follows.
        return re.sub(rb"(?<=[\x81-\xfe])\\", b"?", content).decode("cp1252", errors="replace")


def _statements(text: str, path: Path) -> Iterator[tuple[str, str]]:
    """Keyword and text of each statement.

    cantools reads a file as a whole or not at all, and real ones have faults in messages that are of no interest here.

    Raises:
        DbcError: the file ends within a statement, or a quote has no other one, so that statements may be missing.
    """

    def refuse_lone_quote(between: str) -> None:
        if '"' in re.sub(rf"{_TEXT}|//.*", "", between, flags=re.MULTILINE):
            line, what = text.count("\n", 0, text.index('"', end)) + 1, keyword or "what comes first"
            raise DbcError(
                f"'{path}', line {line}: a quote without its other one in {what}; allowed: two for each text"
            )

    keyword, last, end = "", "", 0
    for found in _STATEMENT.finditer(text):
        refuse_lone_quote(text[end : found.start()])
        keyword, last, end = found[1], found[0].strip(), found.end()
        yield keyword, last
    refuse_lone_quote(text[end:])
    # A last table of values without its semicolon is seen in real files.
    closed = last.endswith(";") or (keyword == "VAL_" and last.endswith('"') and text.endswith("\n"))
    if keyword and not (re.match(_WHOLE[keyword], last) if keyword in _WHOLE else closed):
        raise DbcError(f"'{path}' is cut off: it ends within {keyword}")
