"""A recorded bus again: the frames that a board sent, in their order and at their times."""

from __future__ import annotations

import copy
import struct
import time
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import can
from can.io.blf import BLFParseError

from straightcomp_ros.hardware.can.frames import Identifiers
from straightcomp_ros.hardware.interface import HardwareError

_SEND_TIMEOUT_S = 1.0


class DamagedLog(Exception):
    """A log cannot be read on from here, as after a crash; the message says where."""


def recorded_frames(file: Path) -> Iterator[can.Message]:
    """All frames of a log in any format that python-can reads.

    Raises:
        HardwareError: no such file, or a format that is not known.
        DamagedLog: after the last frame that can be read.
    """
    try:
        reader = can.LogReader(file)
    except OSError as error:
        raise HardwareError(f"log '{file}': {error.strerror or error}") from error
    except (ValueError, BLFParseError, struct.error) as error:
        raise HardwareError(f"log '{file}': {error}") from error
    number = 0
    with reader:
        try:
            for message in reader:
                yield message
                number += 1
        except (ValueError, IndexError, BLFParseError, struct.error, zlib.error, EOFError, OSError) as error:
            raise DamagedLog(f"log '{file}': damaged after frame {number}") from error


def of_the_board(frames: Iterable[can.Message], node: int) -> Iterator[can.Message]:
    """Those frames that the board ``node`` sends."""
    ids = Identifiers(node)
    sent = {ids.encoder, ids.encoder_fd, ids.current, ids.truth, ids.heartbeat}
    for frame in frames:
        if frame.arbitration_id in sent and not (frame.is_extended_id or frame.is_error_frame or frame.is_remote_frame):
            yield frame


def play(frames: Iterable[can.Message], bus: can.BusABC, speed: float) -> int:
    """Send frames at the distances of their stamps divided by ``speed``; returns how many were sent.

    Raises:
        can.CanError: the bus takes them no more.
    """
    sent, begin_s, first_s = 0, time.monotonic(), None
    for frame in frames:
        if first_s is None:
            first_s = frame.timestamp
        due_s = begin_s + (frame.timestamp - first_s) / speed
        time.sleep(max(0.0, due_s - time.monotonic()))
        again = copy.copy(frame)
        again.channel, again.is_rx = None, False
        bus.send(again, timeout=_SEND_TIMEOUT_S)
        sent += 1
    return sent
