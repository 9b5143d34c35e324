"""Records frames as CAN people keep them: candump's ``.log`` or Vector's ``.blf``, by python-can's writers."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import can

from straightcomp_ros.hardware.can.can_parameters import LOG_ENDINGS
from straightcomp_ros.hardware.interface import HardwareError

_QUEUE_LIMIT = 20_000
"""Frames: some seconds of a full bus."""
_WRITE_EVERY_S = 0.02
_SAVE_EVERY_S = 1.0
_AT_ONCE = 8

Writer = can.CanutilsLogWriter | can.BLFWriter


def _candump(file: Path, channel: str, append: bool) -> Writer:
    return can.CanutilsLogWriter(file, channel=channel, append=append)


def _blf(file: Path, _: str, append: bool) -> Writer:
    # The fastest compression: its time is the loop's, too.
    return can.BLFWriter(file, append=append, compression_level=1)


_FORMATS: dict[str, Callable[[Path, str, bool], Writer]] = dict(zip(LOG_ENDINGS, (_candump, _blf), strict=True))


class FrameLog:
    """Writes on a thread of its own; :meth:`put` never waits. A file that is there is kept: the new one gets a number.

    Once a second the file is finished and opened again to be continued, so that SIGKILL takes the last second only: BLF
    keeps frames back to compress them, and has the time at which it begins in a head that is written last.

    Args:
        file: name; its ending, one of LOG_ENDINGS, is the format.
        channel: name of the bus in a candump log.

    Raises:
        HardwareError: the file cannot be made.
    """

    def __init__(self, file: Path, channel: str) -> None:
        # candump separates by blanks, and knows interfaces, not paths.
        self._channel = re.sub(r"\W", "_", Path(channel).name) or "can"
        self._open = _FORMATS[file.suffix.lower()]
        self.file = _unused(file)
        self.written = 0
        """Frames that are in the file, or will be with the next second."""
        self.dropped = 0
        """Frames that found the queue full, or no file."""
        self.problem = ""
        """Why nothing is written any more."""
        self._frames: deque[can.Message] = deque()
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._writer = self._open(self.file, self._channel, False)
        except OSError as error:
            raise HardwareError(f"frame log '{file}': {error.strerror or error}") from error
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="frame log", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, message: can.Message) -> None:
        """Have a frame written soon."""
        if self.problem or len(self._frames) >= _QUEUE_LIMIT:
            self.dropped += 1
        else:
            self._frames.append(message)

    def close(self) -> None:
        """Write what is left, and finish the file."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        else:
            self._writer.stop()

    def _run(self) -> None:
        saved_s = time.monotonic()
        try:
            while not self._closing.wait(_WRITE_EVERY_S):
                self._write()
                if time.monotonic() - saved_s > _SAVE_EVERY_S:
                    self._writer.stop()
                    self._writer = self._open(self.file, self._channel, True)
                    saved_s = time.monotonic()
            self._write()
            self._writer.stop()
        except (OSError, ValueError) as error:
            # A full disk, mostly: the machine runs on.
            self.problem = f"frame log '{self.file}': {error}"
            self.dropped += len(self._frames)
            self._frames.clear()

    def _write(self) -> None:
        frames = self._frames
        while frames:
            for _ in range(min(_AT_ONCE, len(frames))):
                self._writer.on_message_received(frames.popleft())
                self.written += 1
            # The loop may be waiting for the interpreter.
            time.sleep(0)


def _unused(file: Path) -> Path:
    """``file``, or with the first number behind its name that is free."""
    number, free = 0, file
    while free.exists():
        number += 1
        free = file.with_name(f"{file.stem}-{number}{file.suffix}")
    return free
