"""Runs strokes through several boards in turns: other frames, and the firmware core in place of the emulator."""

import statistics
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.hardware.can.dbc_file import DbcError
from straightcomp_ros.hardware.can.frames_in_c import frames_in_c
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from trials.bench.demo_strokes import (
    BenchFailed,
    Figures,
    errors_um,
    figures_of,
    started,
)

_LONGEST_BUILD_S = 300


class MeasuredBoard(NamedTuple):
    """A board to measure: its DBC file's name, who is the board, and the arguments of `straightcomp demo`."""

    frames: str
    kind: str
    arguments: tuple[str, ...]


def boards(stages: Sequence[str | None], firmware: Path | None, folder: Path) -> list[MeasuredBoard]:
    """The emulated board of each stage file, and the firmware core with its frames, which is built in ``folder``.

    Args:
        stages: files with the meaning of a board's frames; None for the package's own.
        firmware: folder firmware/ of the source; None: emulated boards alone.
        folder: gets the programs.

    Raises:
        BenchFailed: a program cannot be built.
        ParameterError: a stage file is refused.
    """
    found = []
    for number, stage in enumerate(stages):
        wire = node_parameters("driver", shipped_parameters(stage=stage)).can.make_wire()
        arguments = ("--stage", stage) if stage else ()
        found.append(MeasuredBoard(wire.dbc.path.name, "emulator", arguments))
        if firmware is not None:
            try:
                texts = frames_in_c([wire])
            except DbcError as error:
                raise BenchFailed(f"{wire.dbc.file}: {error}") from error
            program = _built(firmware, texts, folder / f"firmware_{number}")
            set_program = ("--set", f"driver.can.firmware={program}")
            found.append(MeasuredBoard(wire.dbc.path.name, "C core", (*arguments, *set_program)))
    return found


def _built(firmware: Path, texts: Mapping[str, str], folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    program = folder / "board_posix"
    command = ["make", "-s", "-C", str(firmware), f"GENERATED={folder}", f"BUILD={folder}", str(program)]
    try:
        made = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_BUILD_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BenchFailed(f"make cannot be run: {error}; it needs make and a C compiler") from error
    if made.returncode:
        raise BenchFailed(f"{' '.join(command)}: {(made.stderr.strip() or 'failed').splitlines()[-1]}")
    return program


def measure(
    measured: Sequence[MeasuredBoard],
    rounds: int,
    arguments: Sequence[str],
    folder: Path,
    progress: Callable[[str, float], object] = lambda text, done: None,
) -> dict[str, Any]:
    """One stroke through each board, ``rounds`` times in turns, so that what else the computer does counts for all.

    Args:
        measured: see :func:`boards`.
        rounds: strokes through each.
        arguments: of `straightcomp demo`, for all.
        folder: gets bags and logs.
        progress: called with what begins now and the finished fraction.

    Returns:
        For each board the medians over its strokes with the p-p errors of all, the samples and commands lost in all,
        why strokes ``failed``, since a stall of the host may be a fault for a board with a short counter, and why
        others are ``not_in_order``; None for the medians of a board without a finished stroke. ``in_order``: whether
        every stroke was.
    """
    strokes: list[list[Figures]] = [[] for _ in measured]
    failed: list[list[str]] = [[] for _ in measured]
    for turn in range(rounds):
        for number, board in enumerate(measured):
            progress(f"{board.frames}, {board.kind}", (turn * len(measured) + number) / (rounds * len(measured)))
            output = ("--output", str(folder / f"round_{turn}_board_{number}"))
            process = started(["--hardware", "can", *board.arguments, *arguments, *output])
            try:
                strokes[number].append(figures_of(*process.communicate(), f"{board.frames}, {board.kind}"))
            except BenchFailed as error:
                failed[number].append(str(error))
    found = [
        {"frames": board.frames, "board": board.kind, **_summary(board, own), "failed": why}
        for board, own, why in zip(measured, strokes, failed, strict=True)
    ]
    return {
        "rounds": rounds,
        "boards": found,
        "in_order": not any(one["failed"] or one["not_in_order"] for one in found),
    }


def _summary(board: MeasuredBoard, strokes: Sequence[Figures]) -> dict[str, Any]:
    errors = errors_um(strokes)
    return {
        "pp_um": _median(errors),
        "pp_um_of_each": errors,
        "lost_samples": sum(stroke["lost_samples"] for stroke in strokes),
        "lost_commands": sum(stroke["lost_commands"] for stroke in strokes),
        "latency_p50_us": _median([stroke["latency_p50_us"] for stroke in strokes]),
        "latency_p99_us": _median([stroke["latency_p99_us"] for stroke in strokes]),
        "not_in_order": [
            f"{board.frames}, {board.kind}: {stroke['verdict'].replace('_', ' ')}: {stroke['reason']}"
            for stroke in strokes
            if stroke["verdict"] != IN_ORDER
        ],
    }


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None
