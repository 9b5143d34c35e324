"""How long frames take, and how much of a bus they need."""

import pytest
from can_boards import FOREIGN
from places import page

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.doctor.stage_findings import bus_load, classic_bits, fd_time, frame_time
from straightcomp_ros.hardware.can.can_parameters import CanParameters


def test_the_longest_frames_are_those_of_the_literature():
    # Davis, Burns, Bril and Lukkien, Real-Time Systems 35, 2007: 55 and 80 bits, and 10 for each byte.
    for size in range(9):
        assert (classic_bits(size), classic_bits(size, extended=True)) == (55 + 10 * size, 80 + 10 * size)
    # SRR, IDE and 18 more bits of the identifier, all stuffed with the rest.
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
