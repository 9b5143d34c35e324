import itertools
import random

import pytest
from can_boards import FOREIGN
from places import page

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.doctor.stage_findings import bus_load, classic_bits, fd_time, frame_time
from straightcomp_ros.hardware.can.can_parameters import CanParameters


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


def test_an_identifier_of_29_bits_takes_longer_and_the_longest_frame_of_can_fd_has_680_bits():
    assert classic_bits(8) == 135
    # SRR, IDE and 18 more bits of the identifier, all stuffed with the rest.
    assert classic_bits(8, extended=True) == 160 and classic_bits(0, extended=True) == 80
    assert fd_time(8, 1, 10**9, extended=True) == pytest.approx(36 + 8 + 12, abs=1e-3)
    assert frame_time(FOREIGN.make_wire().command, 1e6, 0.0) == pytest.approx(160e-6)
    # 64 bytes: 517 bits and 130 stuffed, stuff count 4, CRC 21, 7 fixed stuff bits, delimiter.
    assert fd_time(64, 10**9, 1) == pytest.approx(680)


def test_the_document_shows_what_the_code_computes():
    """There, a classic bus at 1 Mbit/s carries the servo, and CAN FD halves load and latency."""
    lines = ["| bus | frame | payload | longest time | load |", "|---|---|---|---|---|"]
    for name, data in (("classic, 1 Mbit/s", 0.0), ("CAN FD, 1 and 5 Mbit/s", 5e6)):
        wire = CanParameters(fd=bool(data)).make_wire()
        loads = bus_load(wire, DEFAULT_RATE, 1e6, data)
        times = {one: frame_time(one, 1e6, data) for one in sorted(loads, key=lambda one: one.identifier)}
        rows = [(one.name, f"{one.size} B", time, loads[one]) for one, time in times.items()]
        # A frame waits for at most one of lower priority, which cannot be interrupted (Davis, Burns, Bril and Lukkien,
        # Real-Time Systems 35, 2007); here for the longest other.
        waits = (max(time for one, time in times.items() if one is not own) for own in (wire.sample, wire.command))
        pair = times[wire.sample] + times[wire.command] + sum(waits)
        rows.append(("all; sample to command", "", pair, sum(loads.values())))
        for what, payload, time, share in rows:
            lines.append(f"| {name} | {what} | {payload} | {time * 1e6:.0f} µs | {100 * share:.1f} % |")
    assert "\n".join(lines) in page("can")
