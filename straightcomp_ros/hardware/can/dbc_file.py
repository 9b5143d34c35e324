"""Reads a DBC file by cantools: the messages of a bus, and where their signals lie."""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from straightcomp_ros.hardware.can.frames import EXTENDED_ID
from straightcomp_ros.settings.share import share_path

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

_LARGEST = {False: 0x7FF, True: 0x1FFFFFFF}
FD_SIZES = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Bytes of a frame of CAN FD."""
_SIZES = {False: tuple(range(9)), True: FD_SIZES}
_LARGEST_FLOAT = {16: 65504.0, 32: (2 - 2.0**-23) * 2.0**127, 64: sys.float_info.max}


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
        self._database = _database(self.path)

    def message(self, name: str) -> Message:
        """The message ``name``, if it can be sent as one frame.

        Raises:
            DbcError: there is none, or no frame has its length.
        """
        try:
            message = self._database.get_message_by_name(name)
        except KeyError:
            known = [message.name for message in self._database.messages]
            raise DbcError(f"'{name}' is not a message of {self.file}{_nearest(name, known)}") from None
        sizes = _SIZES[is_fd(message)]
        if message.length not in sizes:
            raise DbcError(
                f"message '{name}' of {self.file} has {message.length} bytes; allowed: {', '.join(map(str, sizes))}"
            )
        return message

    def signal(self, message: Message, name: str) -> Signal:
        """The signal ``name`` of a message of this file; DbcError if there is none."""
        for signal in message.signals:
            if signal.name == name:
                return signal
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


def limits(signal: Signal) -> tuple[float, float]:
    """Least and largest raw value: what the signal's bits can hold, narrowed by the file's minimum and maximum."""
    if signal.is_float:
        least, largest = -_LARGEST_FLOAT[signal.length], _LARGEST_FLOAT[signal.length]
    elif signal.is_signed:
        least, largest = -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
    else:
        least, largest = 0, 2**signal.length - 1
    if signal.minimum is None or signal.maximum is None or signal.minimum >= signal.maximum:
        return least, largest  # [0|0] says nothing
    ends = sorted((end - signal.offset) / signal.scale for end in (signal.minimum, signal.maximum))
    if signal.is_float:
        return ends[0], ends[1]
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


def _database(path: Path) -> Database:
    # Half a second, which only a driver with a bus needs.
    import cantools

    try:
        database = cantools.database.load_file(path, database_format="dbc")
    except OSError as error:
        raise DbcError(f"'{path}': {error.strerror}") from None
    except (cantools.Error, ValueError, KeyError) as error:
        raise DbcError(f"'{path}' is no valid DBC file: {' '.join(str(error).split())}") from None
    assert isinstance(database, cantools.database.can.Database)
    return database


def _nearest(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(names) or 'none'}"
