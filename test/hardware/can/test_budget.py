import itertools
import random
from pathlib import Path

import pytest

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.hardware.can.budget import (
    CLASSIC_1M,
    FD_1M_5M,
    Traffic,
    classic_bits,
    fd_time,
    load,
    round_trip,
    traffic,
)
from straightcomp_ros.hardware.can.can_parameters import CanParameters

CLASSIC, FD = (CanParameters(fd=fd).make_wire() for fd in (False, True))
DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "can.md"


def stuffed(bits):
    """Bits after stuffing: one of the other kind after five equal ones, itself counted."""
    out = []
    for bit in bits:
        out.append(bit)
        if len(out) >= 5 and len(set(out[-5:])) == 1:
            out.append(1 - bit)
    return len(out)


@pytest.mark.parametrize("size", [1, 5, 8])
def test_no_pattern_needs_more_bits_than_the_bound_and_one_needs_all(size):
    stuffable = 34 + 8 * size
    worst = list(itertools.islice(itertools.chain([0] * 5, itertools.cycle([1] * 4 + [0] * 4)), stuffable))
    unstuffed_end = 13
    assert stuffed(worst) + unstuffed_end == classic_bits(size)
    chance = random.Random(1)
    for _ in range(500):
        bits = [chance.random() < chance.choice([0.05, 0.5, 0.95]) for _ in range(stuffable)]
        assert stuffed([int(bit) for bit in bits]) + unstuffed_end <= classic_bits(size)


def test_a_classic_bus_at_1_mbit_s_carries_the_servo():
    assert classic_bits(8) == 135
    eight = [Traffic(name, 8, 2000, False) for name in ("encoder", "command")]
    assert load(eight, CLASSIC_1M) == pytest.approx(0.54)
    assert round_trip(eight, CLASSIC_1M, ("encoder", "command")) == pytest.approx(540e-6)
    assert load(traffic(CLASSIC, 2000), CLASSIC_1M) < 0.54
    assert round_trip(traffic(CLASSIC, 2000), CLASSIC_1M, ("Encoder", "Command")) < 540e-6


def test_can_fd_halves_load_and_latency():
    # 64 bytes: 517 bits and 130 stuffed, stuff count 4, CRC 21, 7 fixed stuff bits, delimiter.
    assert fd_time(64, 10**9, 1) == pytest.approx(680)
    assert load(traffic(FD, 2000), FD_1M_5M) == pytest.approx(0.26, abs=0.01)
    assert round_trip(traffic(FD, 2000), FD_1M_5M, ("EncoderFd", "CommandFd")) < 270e-6
    sizes = {*range(9), 12, 16, 20, 24, 32, 48, 64}  # ISO 11898-1, DLC
    for size in range(66):
        if size in sizes:
            assert fd_time(size, 10**6, 5 * 10**6) > 0.0
        else:
            with pytest.raises(ValueError, match=f" {size} bytes"):
                fd_time(size, 10**6, 5 * 10**6)


def test_an_identifier_of_29_bits_takes_longer():
    # SRR, IDE and 18 more bits of the identifier, all stuffed with the rest.
    assert classic_bits(8, extended=True) == 160 and classic_bits(0, extended=True) == 80
    assert fd_time(8, 1, 10**9, extended=True) == pytest.approx(36 + 8 + 12, abs=1e-3)
    assert Traffic("one", 8, 1.0, False, True).time(CLASSIC_1M) == pytest.approx(160e-6)


def test_the_document_shows_what_the_code_computes():
    lines = ["| bus | frame | payload | longest time | load |", "|---|---|---|---|---|"]
    for name, fd, bitrate in (("classic, 1 Mbit/s", False, CLASSIC_1M), ("CAN FD, 1 and 5 Mbit/s", True, FD_1M_5M)):
        wire = CanParameters(fd=fd).make_wire()
        sent, pair = traffic(wire, DEFAULT_RATE), (wire.sample.name, wire.command.name)
        rows = [(frame.name, f"{frame.size} B", frame.time(bitrate), load([frame], bitrate)) for frame in sent]
        rows.append(("all; sample to command", "", round_trip(sent, bitrate, pair), load(sent, bitrate)))
        for what, payload, time, share in rows:
            lines.append(f"| {name} | {what} | {payload} | {time * 1e6:.0f} µs | {100 * share:.1f} % |")
    assert "\n".join(lines) in DOCUMENT.read_text()
