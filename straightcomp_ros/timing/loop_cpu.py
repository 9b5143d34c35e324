"""The CPU of a graph's control loop, chosen so that several graphs on one machine do not share one.

Each process of a graph that asks claims the graph's CPU, so the choice holds as long as one of them lives: a node that
is started again finds the others of its graph where it left them.
"""

import hashlib
import os
import socket
from collections.abc import Set

from straightcomp_ros.timing.claimed_names import claim, claimed

_NAME = "straightcomp_ros/loop/"
_CHOICE = "straightcomp_ros/choice"
"""Claimed while a process chooses, so that two graphs which start together see each other."""
_TURN_S = 1.0

_held: list[socket.socket] = []


def loop_cpu(graph: str, permitted: Set[int]) -> int:
    """Claim the CPU of the loop of ``graph`` while this process lives, and return it.

    It is the CPU that a process of this graph has claimed already; otherwise, of those with the fewest other loops,
    the last.

    Args:
        graph: what tells it from other graphs of this machine.
        permitted: the CPUs that this process may use.

    Raises:
        OSError: other processes have been choosing for a second, or the system has no abstract sockets.
    """
    mark = hashlib.blake2b(graph.encode(), digest_size=8).hexdigest()
    choice = claim(_CHOICE, _TURN_S)
    if choice is None:
        raise OSError("other processes are choosing theirs")
    with choice:
        claims = _claims()
        own = {cpu for cpu, owner in claims if owner == mark} & permitted
        loops = [cpu for cpu, _ in {one for one in claims if one[1] != mark}]
        cpu = max(own or permitted, key=lambda each: (-loops.count(each), each))
        # The same process may ask again.
        if mine := claim(f"{_NAME}{cpu}/{mark}/{os.getpid()}"):
            _held.append(mine)
    return cpu


def loop_cpus() -> set[int]:
    """The CPUs on which loops run now, of all graphs."""
    return {cpu for cpu, _ in _claims()}


def _claims() -> list[tuple[int, str]]:
    found = (name.split("/") for name in claimed(_NAME))
    return [(int(cpu), mark) for cpu, mark, _ in found]
