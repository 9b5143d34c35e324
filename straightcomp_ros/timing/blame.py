"""Says in a sentence when a run went wrong, or worse than it could, because processes got no CPU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

NOTED_US = 5_000.0
"""Shorter waits than this, ten samples at 2 kHz, are every desktop's."""
NORMAL, REFUSED = "normal", "normal, real-time priority refused"
"""Scheduling of a node without real-time priority: none asked for, or not permitted."""


class HeldUp(NamedTuple):
    """What held a node up, as far as its diagnostics tell.

    Attributes:
        no_cpu_us: longest time for which a thread of the node was ready to run and got no CPU.
        late_us: the most that its loop was late, for whatever reason.
        scheduling: "FIFO 40", :data:`NORMAL` or :data:`REFUSED`; empty if unknown.
    """

    no_cpu_us: float = 0.0
    late_us: float = 0.0
    scheduling: str = ""

    @property
    def outranked(self) -> bool:
        """Whether other programs can have kept the node from its CPU."""
        return self.scheduling in (NORMAL, REFUSED) and self.no_cpu_us >= NOTED_US


def blamed(nodes: Mapping[str, HeldUp]) -> str:
    """Who was held up, for how long and by what, with the remedy; empty where nobody was for long.

    Args:
        nodes: by name, those whose lateness matters.
    """
    waiting = {name: node.no_cpu_us for name, node in nodes.items() if node.outranked}
    if waiting:
        words = [f"the {name} got no CPU for {waiting[name] * 1e-3:.0f} ms" for name in _longest_first(waiting)]
        refused = any(nodes[name].scheduling == REFUSED for name in waiting)
        return f"{', '.join(words)}; real-time priority {_REFUSED if refused else _NOT_ASKED}"
    late = {name: node.late_us for name, node in nodes.items() if node.late_us >= NOTED_US}
    if late:
        name = _longest_first(late)[0]
        return (
            f"the {name} was late by {late[name] * 1e-3:.0f} ms, and no other program had its CPU: "
            "the kernel, the disk or the hypervisor held it up; remedy: straightcomp doctor"
        )
    return ""


_REFUSED = "is not permitted; remedy: straightcomp doctor"
_NOT_ASKED = "was not asked for; remedy: the parameter realtime.priority"


def _longest_first(times: Mapping[str, float]) -> list[str]:
    return sorted(times, key=lambda name: -times[name])
