"""Recorded buses: candump's ``.log`` or Vector's ``.blf``, written in a thread, read and played by python-can."""

import contextlib
import copy
import gzip
import itertools
import os
import re
import sqlite3
import struct
import tempfile
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, TextIO, cast

import can
from can.io.blf import BLFParseError

from straightcomp_ros.hardware.can.dbc_file import decoded
from straightcomp_ros.hardware.can.hub import NO_DATA
from straightcomp_ros.hardware.can.hub_bus import frame_of
from straightcomp_ros.hardware.interface import HardwareError

_QUEUE_LIMIT = 20_000
"""Frames: some seconds of a full bus."""
_WRITE_EVERY_S, _SAVE_EVERY_S = 0.02, 1.0
_AT_ONCE = 8
_SEND_TIMEOUT_S = 1.0
_NO_FRAME = "its first frame cannot be read; allowed: a whole log of the kind that its ending says"
_JUMP_S, _BACK_S = 60.0, 1.0
"""A running board sends at least its samples: beyond these a clock was set."""
_OF_FORMATS = (BLFParseError, struct.error, zlib.error, sqlite3.Error)
_UNREADABLE = (*_OF_FORMATS, ValueError, LookupError, ArithmeticError, TypeError, EOFError, MemoryError, OSError)
_LINES = (".log", ".asc", ".trc", ".csv")
"""Endings of logs with a line for each frame."""
_MARKED: dict[str, Callable[[TextIO], Any]] = {".log": can.CanutilsLogReader, ".trc": can.TRCReader}
"""Readers that take a mark of UTF-8 for a part of the first line."""
_KINDS: tuple[tuple[bytes, str, str], ...] = (
    (rb"\(\d+\.\d+\) \S+ [0-9A-Fa-f]+#", ".log", "a log of candump"),
    (rb"[ ;\t]*(date\s|base\s+(hex|dec)\b)", ".asc", "an ASC log of Vector"),
    (rb";\$FILEVERSION|;.*PCAN|;\s+Message Number", ".trc", "a trace of PEAK"),
    (rb"timestamp,arbitration_id,", ".csv", "a CSV log of python-can"),
    (rb"LOGG", ".blf", "a BLF log of Vector"),
    (rb"MDF     |UnFinMF ", ".mf4", "a log in MDF"),
    (rb"SQLite format 3", ".db", "a bag, which straightcomp replay reads, or a database of python-can"),
    (
        rb"\s*(\([-\d.: ]+\)\s+)?\S+\s+(([RT]X|[-BE]+)\s+)*[0-9A-Fa-f]{3,8}\s+\[ *\d+\]",
        "",
        "what candump shows on the screen; record with candump -L or -l",
    ),
    (rb"\*\*\*BUSMASTER", "", "a log of BusMaster; export it as .asc"),
    (rb"Time Stamp,ID,Extended", "", "a log of SavvyCAN in GVRET's format; save it as a candump log"),
    (rb"\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\n\r\r\n", "", "a capture of Wireshark; record with candump -L or -l"),
    (rb"\x89MCAP", "", "an MCAP bag; straightcomp replay reads those"),
    (rb"\xff\xfe|\xfe\xff", "", "text in UTF-16; save it as UTF-8"),
)
"""By how a line of its first ones, or the file, begins: the ending of a kind of log, and what it is."""


class FrameLog:
    """Writes in its own thread; :meth:`put` never blocks. An existing file is kept: the new one gets a number.

    Once a second the file is finished and opened again to continue it, so that SIGKILL costs the last second only: the
    BLF writer buffers frames to compress them, and writes the start time in the file's head when it ends.

    The ending of ``file``, ``.log`` or ``.blf``, is the format; ``channel`` is the name of the bus in a candump log.

    Raises:
        HardwareError: the file cannot be made.
    """

    written = 0
    """Frames that are in the file, or will be within a second."""
    dropped = 0
    """Frames for which there was no room in the queue, or no file."""
    problem = ""
    """Why nothing is written any more."""

    def __init__(self, file: Path, channel: str) -> None:
        # candump separates by blanks, and knows interfaces, not paths.
        name = re.sub(r"\W", "_", Path(channel).name) or "can"
        # can.Logger would look for plugins each time. The fastest compression, since its time is the loop's, too.
        candump, blf = partial(can.CanutilsLogWriter, channel=name), partial(can.BLFWriter, compression_level=1)
        formats: dict[str, Callable[..., Any]] = {".log": candump, ".blf": blf}
        self._open = formats[file.suffix.lower()]
        numbered = (file.with_name(f"{file.stem}-{number}{file.suffix}") for number in itertools.count(1))
        self.file = next(free for free in itertools.chain([file], numbered) if not free.exists())
        self._frames: deque[can.Message] = deque()
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._writer = self._open(self.file)
        except OSError as error:
            raise HardwareError(f"frame log '{file}': {error.strerror or error}") from error
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="frame log", daemon=True)

    def start(self) -> None:
        """Start writing, unless it has started."""
        if self._thread.ident is None:
            self._thread.start()

    def put(self, message: can.Message) -> None:
        """Queue a frame to be written."""
        if self.problem or len(self._frames) >= _QUEUE_LIMIT:
            self.dropped += 1
        else:
            self._frames.append(message)

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        else:
            # What kept the thread from writing may keep the file from being finished.
            with contextlib.suppress(OSError, ValueError):
                self._writer.stop()

    def _run(self) -> None:
        saved_s = time.monotonic()
        try:
            while not self._closing.wait(_WRITE_EVERY_S):
                self._write()
                if time.monotonic() - saved_s > _SAVE_EVERY_S:
                    self._writer.stop()
                    self._writer = self._open(self.file, append=True)
                    saved_s = time.monotonic()
            self._write()
            self._writer.stop()
        except (OSError, ValueError) as error:
            # Usually a full disk: the machine goes on.
            self.problem = f"frame log '{self.file}': {error}"
            self.dropped += len(self._frames)
            self._frames.clear()

    def _write(self) -> None:
        while self._frames:
            self._writer.on_message_received(self._frames.popleft())
            self.written += 1
            if self.written % _AT_ONCE == 0:
                # The control loop may be waiting for the interpreter's lock.
                time.sleep(0)


class RecordedBus:
    """The frames of a log in any format that python-can reads; with ``channel`` those of one of its buses, named or
    numbered as in the file.

    Iterating raises HardwareError if there is no such file, or its format is not known. A log that is damaged, as after
    a crash, ends with the last frame that can be read.
    """

    damage = ""
    """After which frame the log is damaged; known at its end."""

    def __init__(self, file: Path, channel: str | None = None) -> None:
        self._file, self._channel = file, channel
        self._ending = Path(file.name.lower().removesuffix(".gz")).suffix

    def __iter__(self) -> Iterator[can.Message]:
        number = 0
        try:
            with self._reader() as reader:
                cut = _is_cut(self._file, self._ending)
                for message in _all_but_the_last(reader) if cut and self._ending in _LINES else reader:
                    frame_of(message)  # raises for what is no frame: a time that is no number, an empty cell
                    number += 1
                    if self._ending in (".asc", ".blf") and isinstance(message.channel, int):
                        message.channel += 1  # python-can counts from 0, the file from 1
                    if self._channel in (None, str(message.channel)):
                        yield message
        except _UNREADABLE:
            cut = True
        if cut:
            self.damage = f"damaged after frame {number}" if number else _NO_FRAME

    def _reader(self) -> Any:
        try:
            with self._file.open("rb") as opened:
                _refuse_another_kind(self._file.suffix.lower(), opened.read(4096))
            if self._ending == ".asc":
                return can.ASCReader(_plain_asc(self._file))
            if self._ending in _MARKED:
                return _MARKED[self._ending](_opened(self._file, "rt", encoding="utf-8-sig"))
            return can.LogReader(self._file)
        except NotImplementedError as error:
            raise HardwareError("MDF needs asammdf; install it by pip, or export the log as .blf or .asc") from error
        except (OSError, ValueError, BLFParseError, struct.error) as error:
            raise HardwareError(getattr(error, "strerror", None) or str(error)) from error


def _is_cut(file: Path, ending: str) -> bool:
    """Whether the end of a log is missing: that of its last line, of which a reader makes a shorter frame, or that of a
    BLF file by its head or its last container, of which a reader says nothing, or that of what was compressed."""
    with _opened(file, "rb") as opened:
        try:
            size = opened.seek(0, os.SEEK_END)
        except _UNREADABLE:
            return True
        if ending in _LINES:
            opened.seek(max(0, size - 1))
            return opened.read() not in (b"", b"\n", b"\r")
        if ending != ".blf":
            return False
        opened.seek(0)
        place, end = struct.unpack("<4xL8xQ", opened.read(24))  # of a file that was never finished the end is not known
        opened.seek(place)
        while (head := opened.read(12)).startswith(b"LOBJ") and len(head) == 12:
            length = int.from_bytes(head[8:], "little")
            end, place = max(end, place + length), place + max(12, length) + length % 4
            opened.seek(place)
        return bool(size < end)


def _all_but_the_last(frames: Iterable[can.Message]) -> Iterator[can.Message]:
    """The frames without that of a line whose end is missing, if it can be read at all."""
    last = None
    try:
        for frame in frames:
            if last is not None:
                yield last
            last = frame
    except _UNREADABLE:
        if last is not None:
            yield last
        raise


def _refuse_another_kind(suffix: str, head: bytes) -> None:
    lines = [head, *head.removeprefix(b"\xef\xbb\xbf").splitlines()[:20]]
    for pattern, ending, kind in _KINDS:
        if any(re.match(pattern, line) for line in lines):
            if suffix != ending:
                raise HardwareError(f"is {kind}" + (f"; allowed: the ending {ending}" if ending else ""))
            return


def _opened(file: Path, mode: str, **options: str) -> Any:
    opener: Callable[..., Any] = gzip.open if file.suffix.lower() == ".gz" else open
    return opener(file, mode, **options)


def _plain_asc(file: Path) -> TextIO:
    """The lines of an ASC log as python-can reads them: in UTF-8, without the date, which has the words of some
    language, and with times from the beginning. "relative" ones count from the line before, whatever that holds.

    An empty line ends the head: the reader ends it by dropping the first line that it does not know, perhaps a frame.
    """
    plain = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115
    relative, begun, now = False, False, Decimal(0)
    # What is left of a compressed log that was cut off is read, as of others.
    with _opened(file, "rb") as opened, contextlib.suppress(*_UNREADABLE):
        for content in opened:
            line = decoded(content)
            relative = relative or re.match(r"\s*base\s+\w+\s+timestamps\s+relative", line, re.IGNORECASE) is not None
            timed = re.match(r"\s*(\d+\.\d+)(?=\s)", line)
            if timed and not begun:
                begun = True
                plain.write("\n")
            if relative and timed:
                now += Decimal(timed[1])
                line = f"{now}{line[timed.end() :]}"
            if not re.match(r"\s*date\s", line, re.IGNORECASE):
                plain.write(line)
    plain.seek(0)
    return cast("TextIO", plain)


def check_times_and_buses(frames: Iterable[can.Message]) -> int:
    """How many frames of one board a log has.

    Raises:
        HardwareError: they are of several buses, or the clock of the recorder jumped.
    """
    number, last = 0, None
    for number, frame in enumerate(frames, 1):
        last = last or frame
        step_s = frame.timestamp - last.timestamp
        if frame.channel != last.channel:
            raise HardwareError(
                f"has frames of the board on {last.channel} and {frame.channel}, which are two boards' or one's twice; "
                "allowed: one bus (--channel)"
            )
        if not -_BACK_S <= step_s <= _JUMP_S:
            raise HardwareError(
                f"the clock of the recorder jumped by {step_s:.1f} s after frame {number - 1} of the board; "
                f"allowed: -{_BACK_S:g} to {_JUMP_S:g} s"
            )
        last = frame
    return number


def of_the_board(frames: Iterable[can.Message], identifiers: Collection[int]) -> Iterator[can.Message]:
    """The frames with one of these identifiers; EXTENDED_ID is set in those of 29 bits."""
    for frame in frames:
        known = frame_of(frame)
        if known.identifier in identifiers and not known.flags & NO_DATA:
            yield frame


def play(frames: Iterable[can.Message], bus: can.BusABC, speed: float) -> int:
    """Send frames at the intervals of their stamps divided by ``speed``; returns how many were sent.

    Raises:
        can.CanError: the bus does not accept a frame.
    """
    number, begin_s, first_s = 0, 0.0, 0.0
    for number, frame in enumerate(frames, 1):
        if number == 1:
            # Not before: the end of a large compressed log is found by seconds of reading.
            begin_s, first_s = time.monotonic(), frame.timestamp
        due_s = begin_s + (frame.timestamp - first_s) / speed
        time.sleep(max(0.0, due_s - time.monotonic()))
        again = copy.copy(frame)
        again.channel, again.is_rx = None, False
        bus.send(again, timeout=_SEND_TIMEOUT_S)
    return number
