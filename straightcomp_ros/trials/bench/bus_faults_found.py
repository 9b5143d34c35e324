"""Counts how many injected bus faults are detected, and how the machine reacts to them."""

from collections.abc import Callable
from typing import Any

from straightcomp_ros.hardware.can.bus_faults import KINDS
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.trials.bench.can_fault_trial import run_trial
from straightcomp_ros.trials.bench.can_servo_trial import run_servo_trial

_RATE = 0.02
_TOGETHER, _CUT = 0.002, 0.0002
"""Rates of all kinds together, for a closed loop that stays on most of the time."""
COUNTED = tuple(kind for kind in KINDS if kind != "cut")
"""Kinds that damage one frame. A cut affects the link, and is tested on a real one."""
_BUSES = {"classic": False, "fd": True}


def fault_run(
    guide: StraightnessMap, frames: int, seed: int, progress: Callable[[float], object]
) -> tuple[dict[str, dict[str, int]], dict[str, dict[str, Any]], int]:
    """Test each kind of fault alone on the receiver, and all together on the closed loop, on both kinds of bus.

    Args:
        guide: of the simulated machine.
        frames: number for each kind and bus, and for each closed loop.
        seed: of the faults.
        progress: called with the finished fraction.

    Returns:
        By kind the counts ``injected`` and ``detected`` on both buses; by bus the result of the closed loop; the total
        of wrong samples that were used unflagged.
    """
    counts = {kind: {"injected": 0, "detected": 0} for kind in COUNTED}
    loops: dict[str, dict[str, Any]] = {}
    wrong, done, steps = 0, 0, (len(COUNTED) + 1) * len(_BUSES)
    for bus, fd in _BUSES.items():
        for kind in COUNTED:
            trial = run_trial({kind: _RATE}, fd=fd, frames=frames, seed=seed)
            counts[kind]["injected"] += trial.injected[kind]
            counts[kind]["detected"] += trial.detected(kind)
            wrong += trial.unflagged_wrong
            done += 1
            progress(done / steps)
        rates = {kind: _CUT if kind == "cut" else _TOGETHER for kind in KINDS}
        loop = run_servo_trial(rates, guide, fd=fd, frames=frames, seed=seed)
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
