"""Counts how many injected bus faults are detected, and how the machine reacts to them."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.hub import KINDS
from straightcomp_ros.straightness.guide_map import StraightnessMap
from trials.bench.can_fault_trial import run_trial
from trials.bench.can_servo_trial import run_servo_trial

_RATE = 0.02
_TOGETHER, _CUT = 0.002, 0.0002
"""Rates of all kinds together, for a closed loop that stays on most of the time."""
COUNTED = tuple(kind for kind in KINDS if kind != "cut")
"""Kinds that damage one frame. A cut affects the link, and is tested on a real one."""


def buses(board: CanParameters) -> dict[str, CanParameters]:
    """Kinds of bus by name on which faults are injected: both of the package's own DBC file, or the one of another."""
    if board.dbc:
        return {Path(board.dbc).stem: board}
    return {name: dataclasses.replace(board, fd=fd) for name, fd in (("classic", False), ("fd", True))}


def fault_run(
    guide: StraightnessMap, board: CanParameters, frames: int, seed: int, progress: Callable[[float], object]
) -> tuple[dict[str, dict[str, int]], dict[str, dict[str, Any]], int]:
    """Test each kind of fault alone on the receiver, and all together on the closed loop, on each of :func:`buses`.

    Args:
        guide: of the simulated machine.
        board: its DBC file.
        frames: number for each kind and bus, and for each closed loop.
        seed: of the faults.
        progress: called with the finished fraction.

    Returns:
        By kind the counts ``injected`` and ``detected`` on all buses; by bus the result of the closed loop; the total
        of wrong samples that were used unflagged.
    """
    counts = {kind: {"injected": 0, "detected": 0} for kind in COUNTED}
    loops: dict[str, dict[str, Any]] = {}
    tried = buses(board)
    wrong, done, steps = 0, 0, (len(COUNTED) + 1) * len(tried)
    for bus, parameters in tried.items():
        for kind in COUNTED:
            trial = run_trial({kind: _RATE}, parameters, frames=frames, seed=seed)
            counts[kind]["injected"] += trial.injected[kind]
            counts[kind]["detected"] += trial.detected(kind)
            wrong += trial.unflagged_wrong
            done += 1
            progress(done / steps)
        rates = {kind: _CUT if kind == "cut" else _TOGETHER for kind in KINDS}
        loop = run_servo_trial(rates, guide, parameters, frames=frames, seed=seed)
        wrong += loop.unflagged_wrong
        loops[bus] = {
            "frames": loop.frames,
            "injected": sum(loop.injected.values()),
            "state": loop.state.value,
            "on": loop.on,
            "latched": dict(loop.latched),
            "unsafe": loop.unsafe,
        }
        done += 1
        progress(done / steps)
    return counts, loops, wrong
