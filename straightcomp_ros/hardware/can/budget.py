"""Worst-case time of each frame on the wire, and bus load.

They hold for the worst case of bit stuffing on an error-free bus. Source: ISO 11898-1:2015.
"""

from collections.abc import Mapping
from typing import NamedTuple

from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.frames import Frames
from straightcomp_ros.hardware.can.hub import addressed, priority


class Bitrate(NamedTuple):
    """Bit rates in bit/s; ``data`` is that of the data phase of CAN FD, None on a classic bus."""

    nominal: int
    data: int | None = None


CLASSIC_1M = Bitrate(1_000_000)
FD_1M_5M = Bitrate(1_000_000, 5_000_000)


def classic_bits(size: int, *, extended: bool = False) -> int:
    """Most bits of a classic frame with ``size`` bytes, with intermission.

    With an identifier of 11 bits there are 34 bits that are stuffed with the payload, at worst with one bit after every
    four, and 13 that are not. An identifier of 29 bits adds 20.
    """
    stuffable = 34 + 20 * extended + 8 * size
    return stuffable + (stuffable - 1) // 4 + 13


def fd_time(size: int, nominal: int, data: int, *, extended: bool = False) -> float:
    """Longest time in s of an FD frame with bit rate switch.

    Nominal rate: SOF, identifier of 11 bits, RRS, IDE, FDF, res and BRS, 17 bits and up to 4 stuff bits; an identifier
    of 29 bits adds 19; ACK, its delimiter, EOF and intermission, 12 bits. Data rate: ESI, DLC and payload, at worst
    with a stuff bit after every four; stuff count, CRC and their fixed stuff bits; the CRC delimiter.
    """
    arbitration, payload, crc = 17 + 19 * extended, 5 + 8 * size, 17 if size <= 16 else 21
    slow = arbitration + (arbitration - 1) // 4 + 12
    fixed_stuff = 1 + (4 + crc - 1) // 4
    return slow / nominal + (payload + (payload + 3) // 4 + 4 + crc + fixed_stuff + 1) / data


def frame_time(frames: Frames, bitrate: Bitrate) -> float:
    """Longest time of one of these frames on the wire in s, with the space to the next frame."""
    extended = bool(frames.identifier & EXTENDED_ID)
    if frames.fd and bitrate.data:
        return fd_time(frames.size, bitrate.nominal, bitrate.data, extended=extended)
    return classic_bits(frames.size, extended=extended) / bitrate.nominal


def traffic(wire: Wire, rate: float) -> dict[Frames, float]:
    """All frames on the bus while the servo runs at ``rate`` in Hz, highest priority first, and how many a second."""
    rates = {frames: rate / frames.every for frames in (*wire.commands, *wire.reports.values())}
    if wire.heartbeat:
        rates[wire.heartbeat] = 1.0 / wire.heartbeat.period
    ranked = sorted(rates, key=lambda frames: priority(addressed(frames.identifier, b"", fd=False)))
    return {frames: rates[frames] for frames in ranked}


def load(sent: Mapping[Frames, float], bitrate: Bitrate) -> float:
    """Fraction of the time for which the bus is busy, at worst."""
    return sum(frame_time(frames, bitrate) * rate for frames, rate in sent.items())
