"""Says in a sentence when a run went wrong, or worse than it could, because processes got no CPU."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

NOTED_US = 5_000.0
"""Shorter waits than this, ten samples at 2 kHz, are every desktop's."""
NORMAL, REFUSED = "normal", "normal, real-time priority refused"
"""Scheduling of a node without real-time priority: none asked for, or not permitted."""


class HeldUp(NamedTuple):
    """What a node's diagnostics say of what held it up.

    Attributes:
        cpu_wait_us: longest time for which a thread of the node was ready and got no CPU; NaN if unknown.
        late_us: the most that its loop was late; NaN if unknown.
        scheduling: "FIFO 40", :data:`NORMAL` or :data:`REFUSED`; empty if unknown.
    """

    cpu_wait_us: float = math.nan
    late_us: float = math.nan
    scheduling: str = ""


def blamed(nodes: Mapping[str, HeldUp]) -> str:
    """Who got no CPU and for how long, with the remedy; empty where nobody was held up for long.

    Args:
        nodes: by name, those whose lateness matters.
    """
    waiting = {name: node.cpu_wait_us for name, node in nodes.items() if node.cpu_wait_us >= NOTED_US}
    if waiting:
        longest = sorted(waiting, key=lambda name: -waiting[name])
        words = ", ".join(f"the {name} for {waiting[name] * 1e-3:.0f} ms" for name in longest)
        return f"other programs held the CPUs: {words}; {_remedy({nodes[name].scheduling for name in waiting})}"
    late = {name: node.late_us for name, node in nodes.items() if node.late_us >= NOTED_US}
    if late:
        name = max(late, key=lambda name: late[name])
        return (
            f"the {name} stood still for {late[name] * 1e-3:.0f} ms though no other program held its CPU: "
            "the machine itself stood still, or waited for its disk; remedy: straightcomp doctor"
        )
    return ""


def _remedy(scheduling: set[str]) -> str:
    if REFUSED in scheduling:
        return "real-time priority is not permitted; remedy: straightcomp doctor"
    if NORMAL in scheduling:
        return "real-time priority was not asked for; remedy: the parameter realtime.priority"
    return "at real-time priority; remedy: straightcomp doctor, and CPUs of their own for these nodes"
