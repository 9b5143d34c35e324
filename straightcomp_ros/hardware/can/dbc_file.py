"""Reads a DBC file by cantools: the messages of a bus, and where their signals lie."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from straightcomp_ros.hardware.can.frames import EXTENDED_ID
from straightcomp_ros.parameters.share import share_path

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_LARGEST = {False: 0x7FF, True: 0x1FFFFFFF}
FD_SIZES = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Bytes of a frame of CAN FD."""
_SIZES = {False: tuple(range(9)), True: FD_SIZES}
_LARGEST_FLOAT = {16: 65504.0, 32: (2 - 2.0**-23) * 2.0**127, 64: sys.float_info.max}
_TOKEN = re.compile(r'"(?:\\"|[^"])*?"|//[^\n]*|\w+|[^\w\s]')
_CLOSED = frozenset(
    re.findall(
        r"\w+",
        "BA_ BA_DEF_ BA_DEF_DEF_ BA_DEF_DEF_REL_ BA_DEF_REL_ BA_DEF_SGTYPE_ BA_REL_ BA_SGTYPE_ BO_TX_BU_ CAT_ CAT_DEF_ "
        "CM_ ENVVAR_DATA_ EV_ EV_DATA_ FILTER SGTYPE_ SGTYPE_VAL_ SG_MUL_VAL_ SIGTYPE_VALTYPE_ SIG_GROUP_ "
        "SIG_TYPE_REF_ SIG_VALTYPE_ VAL_ VAL_TABLE_",
    )
)
"""Statements that a semicolon ends."""
_WHOLE = {
    "VERSION": r'VERSION\s*"',
    "NS_": r"(?!)",
    "BS_": r"BS_\s*:",
    "BU_": r"BU_\s*:",
    "BO_": r"BO_\s+\d+\s+\w+\s*:\s*\d+\s+\w",
    "SG_": r'SG_\s[^"]*"[^"]*"\s*\w',
}
"""How the statements that no semicolon ends are when they are whole. The list of NS_ ends where another begins."""
_MESSAGE = re.compile(r"BO_\s+(\d+)\s+(\w+)")
_SIGNAL = re.compile(r"SG_\s+(\w+)")
_OF_SIGNAL = re.compile(r"(?:VAL_|SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+)\s+(\w+)")
_ATTRIBUTE = re.compile(
    r'(BA_|BA_DEF_|BA_DEF_DEF_)\s+(?:BO_\s+|SG_\s+)?"([^"]*)"(?:\s+(?:BO_|SG_)\s+(\d+)(?:\s+(\w+))?)?'
)
_LONG_NAME = "SystemMessageLongSymbol"
_READ = {"GenMsgCycleTime", "GenSigStartValue", "VFrameFormat", "SystemSignalLongSymbol", _LONG_NAME}
"""Attributes that mean something to the driver."""


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
        self._statements = list(_statements(_text(self.path), self.path))
        self._messages: dict[str, Message] = {}
        self._known: dict[str, list[tuple[str, str]]] = {}
        matches = [match for _, text in self._statements if (match := _MESSAGE.match(text))]
        named = [(match[1], match[2]) for match in matches]
        for number, short in named:
            self._known.setdefault(short, []).append((number, short))
        for _, text in self._statements:
            attribute = _ATTRIBUTE.match(text)
            if attribute and attribute[1] == "BA_" and attribute[2] == _LONG_NAME:
                name = text.split('"')[3]
                found = [pair for pair in named if pair[0] == attribute[3] and pair[1] != name]
                self._known.setdefault(name, []).extend(found)
        if not named:
            raise DbcError(f"'{self.path}' is no valid DBC file: it has no message (BO_)")

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
            raise DbcError(f"'{name}' is not a message of {self.file}{_nearest(name, self._known)}")
        if len(found) > 1:
            identifiers = " and ".join(f"{int(number) & ~EXTENDED_ID:#x}" for number, _ in found)
            raise DbcError(f"message '{name}' is in {self.file} {len(found)} times, as {identifiers}; allowed: once")
        try:
            database = cantools.database.load_string("\n".join(self._about(*found[0])), "dbc", strict=False)
            assert isinstance(database, cantools.database.can.Database)
            (message,) = database.messages
        except (cantools.Error, ValueError, LookupError, TypeError, ArithmeticError, AssertionError) as error:
            reason = " ".join(str(error).split())
            raise DbcError(f"message '{name}' of {self.file} cannot be read: {reason}") from None
        sizes = _SIZES[is_fd(message)]
        if message.length not in sizes:
            raise DbcError(
                f"message '{name}' of {self.file} has {message.length} bytes; allowed: {', '.join(map(str, sizes))}"
            )
        return message

    def _about(self, number: str, short: str) -> Iterator[str]:
        """The statements of one message. Those of signals that are gone have been left over."""
        signals: set[str] = set()
        inside, defined = False, set()
        for keyword, text in self._statements:
            if keyword == "BO_":
                inside = (match := _MESSAGE.match(text)) is not None and match.groups() == (number, short)
            if inside and keyword in ("BO_", "SG_"):
                signals.update(_SIGNAL.findall(text)[:1])
                yield text
        for _, text in self._statements:
            attribute, signal = _ATTRIBUTE.match(text), _OF_SIGNAL.match(text)
            if attribute and attribute[1] != "BA_" and attribute[2] in _READ:
                defined.add(attribute[2])
                yield text
            elif signal and signal[1] == number and signal[2] in signals:
                yield text
        for _, text in self._statements:
            attribute = _ATTRIBUTE.match(text)
            if attribute and attribute[1] == "BA_" and attribute[2] in defined and attribute[3] == number:
                yield text

    def signal(self, message: Message, name: str) -> Signal:
        """The signal ``name`` of a message of this file; DbcError if there is none."""
        found = [signal for signal in message.signals if signal.name == name]
        if len(found) > 1:
            raise DbcError(f"'{name}' is {len(found)} signals of message '{message.name}' of {self.file}; allowed: one")
        if found:
            return found[0]
        known = [signal.name for signal in message.signals]
        raise DbcError(f"'{name}' is not a signal of message '{message.name}' of {self.file}{_nearest(name, known)}")

    def identifier(self, message: Message, node: int) -> int:
        """CAN identifier for ``node``: that in the file is node 1's. EXTENDED_ID is set in one of 29 bits."""
        identifier, extended = message.frame_id + node - 1, message.is_extended_frame
        if identifier > _LARGEST[extended]:
            raise DbcError(
                f"{node} moves message '{message.name}' of {self.file} from identifier {message.frame_id:#x} to "
                f"{identifier:#x}; allowed: <= {_LARGEST[extended]:#x}"
            )
        return identifier | EXTENDED_ID if extended else identifier


def is_fd(message: Message) -> bool:
    """Whether the message is a frame of CAN FD: the file says so, or it is too long for another."""
    return message.is_fd or message.length > 8


def limits(signal: Signal, *, narrowed: bool = True) -> tuple[float, float]:
    """Least and largest raw value: what the signal's bits can hold, ``narrowed`` by the file's minimum and maximum."""
    if signal.is_float:
        least, largest = -_LARGEST_FLOAT[signal.length], _LARGEST_FLOAT[signal.length]
    elif signal.is_signed:
        least, largest = -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
    else:
        least, largest = 0, 2**signal.length - 1
    if not narrowed or signal.minimum is None or signal.maximum is None or signal.minimum >= signal.maximum:
        return least, largest  # [0|0] says nothing
    ends = sorted((end - signal.offset) / signal.scale for end in (signal.minimum, signal.maximum))
    if signal.is_float:
        return max(least, ends[0]), min(largest, ends[1])
    return max(least, round(ends[0])), min(largest, round(ends[1]))


def modulus(signal: Signal) -> int:
    """Of a counter: one more than its largest raw value."""
    return int(limits(signal)[1]) + 1


def _found(file: str) -> Path:
    path = Path(os.path.expanduser(file))
    if not os.path.exists(path):
        try:
            return share_path(file)
        except FileNotFoundError:
            raise DbcError(f"'{file}': No such file; name a DBC file") from None
    return path.absolute()  # it is read later, perhaps from another folder


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DbcError(f"'{path}': {error.strerror}") from None
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # What Vector's tools write in Europe.
        return content.decode("cp1252", errors="replace")


def _statements(text: str, path: Path) -> Iterator[tuple[str, str]]:
    """Keyword and text of each statement.

    cantools reads a file as a whole or not at all, and real ones have faults in messages that are of no interest here.

    Raises:
        DbcError: the file ends within a statement, so that others may be missing.
    """
    keyword, begin, end, closed, before = "", 0, 0, True, ""
    for token in _TOKEN.finditer(text):
        word = token[0]
        if word.startswith("//"):
            continue
        first = not end or "\n" in text[end : token.start()]
        if word == '"':
            raise DbcError(f"'{path}' is cut off: it ends within a text of {keyword or 'its first line'}")
        listed = keyword == "NS_" and not text[token.end() :].split("\n", 1)[0].strip()
        inside = keyword in _CLOSED and not closed and not (first and before != keyword)
        if (word in _CLOSED or word in _WHOLE) and not listed and not inside:
            if keyword:
                yield keyword, text[begin:end]
            keyword, begin, closed = word, token.start(), False
        before, end = word, token.end()
        closed = closed or word == ";"
    # A last table of values without its semicolon is seen in real files.
    last = closed or (keyword == "VAL_" and before.endswith('"') and text.endswith("\n"))
    if not (last if keyword in _CLOSED else re.match(_WHOLE.get(keyword, ""), text[begin:end])):
        raise DbcError(f"'{path}' is cut off: it ends within {keyword}")
    if keyword:
        yield keyword, text[begin:end]


def _nearest(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(names) or 'none'}"
