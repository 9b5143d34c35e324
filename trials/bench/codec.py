"""Measures the cost of packing and unpacking the frames that the DBC file describes."""

import statistics
from collections.abc import Callable, Iterable
from typing import Any

from straightcomp_ros.bench.step_costs import cost
from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.frames import Amplifier, Command, Report

_CALLS = 1000
_REPORT = Report(4, 4, 1.2345678, -67.8e-6, -0.09, Amplifier.ON, 0, True)
_COMMAND = Command(3, True, False, -0.05, 4)


def codec_costs(wires: Iterable[Wire], repeats: int) -> dict[str, dict[str, float]]:
    """Median µs to pack (``pack_us``) and to unpack (``unpack_us``) each frame, by its name in the DBC file."""
    frames: dict[str, tuple[Callable[[Any], bytes], Callable[[bytes], object], Any]] = {}
    for wire in wires:
        for one in wire.reports.values():
            frames[one.name] = _first_page(one.pack), one.unpack, _REPORT
        for asked in wire.commands:
            frames[asked.name] = asked.pack, asked.unpack, _COMMAND
    return {
        name: {
            "pack_us": cost(_calls(pack, frame), _CALLS, repeats).median,
            "unpack_us": cost(_calls(unpack, pack(frame)), _CALLS, repeats).median,
        }
        for name, (pack, unpack, frame) in frames.items()
    }


def per_frame(costs: dict[str, dict[str, float]], key: str, wire: Wire) -> float:
    """Mean of ``key`` in :func:`codec_costs` over the frames of a control cycle: those of a sample and of a command."""
    return statistics.mean(costs[frames.name][key] for frames in (*wire.parts, *wire.commands))


def _first_page(pack: Callable[[Report, int], bytes]) -> Callable[[Report], bytes]:
    return lambda report: pack(report, 0)


def _calls(work: Callable[[Any], object], argument: Any) -> Callable[[], None]:
    def calls() -> None:
        for _ in range(_CALLS):
            work(argument)

    return calls
