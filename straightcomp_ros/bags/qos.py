"""The quality of service that a recorded topic was offered with; `ros2 bag play` offers it again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import yaml

from straightcomp_ros.bags import BagError
from straightcomp_ros.parameters.yaml_text import load_yaml

_POLICIES = {
    "history": ("keep_last", "keep_all", "unknown", "system_default"),
    "reliability": ("reliable", "best_effort", "unknown", "best_available", "system_default"),
    "durability": ("transient_local", "volatile", "unknown", "best_available", "system_default"),
}
"""The names in rmw/qos_string_conversions.c, which metadata version 9 stores. Older metadata stores the numbers in
rmw/types.h: 1 is the first name, 0 the last."""
_INFINITE = {"sec": 9223372036, "nsec": 854775807}
"""RMW_DURATION_INFINITE: 2⁶³ − 1 ns."""


@dataclass(frozen=True)
class TopicQos:
    """Quality of service of one topic; deadline, lifespan and lease are infinite, liveliness is automatic.

    Attributes:
        reliability: ``reliable``, ``best_effort``, …
        durability: ``volatile``, ``transient_local``, …
        history: ``keep_last``, ``keep_all``, …
        depth: messages kept with ``keep_last``.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "keep_last"
    depth: int = 10

    def __post_init__(self) -> None:
        for field, allowed in _POLICIES.items():
            if getattr(self, field) not in allowed:
                raise BagError(f"QoS {field} is '{getattr(self, field)}': allowed are {', '.join(allowed)}")
        if self.depth < 0:
            raise BagError(f"QoS depth is {self.depth}: allowed is 0 or more")

    @classmethod
    def from_yaml(cls, text: str) -> TopicQos:
        """The first profile of a list as rosbag2 stores it, with names or (before Jazzy) numbers. What it lacks has its
        default; a text that is no such list gives the default of all."""
        try:
            profile = (load_yaml(text) or [{}])[0]
            named = {name: _named(name, profile[name]) for name in _POLICIES if name in profile}
            return cls(**named, depth=int(profile.get("depth", cls.depth)))
        except (BagError, AttributeError, LookupError, TypeError, ValueError):
            return cls()

    def as_profiles(self) -> list[dict[str, object]]:
        """The list of one profile that stands in metadata.yaml as ``offered_qos_profiles``."""
        return [
            {
                "history": self.history,
                "depth": self.depth,
                "reliability": self.reliability,
                "durability": self.durability,
                "deadline": dict(_INFINITE),
                "lifespan": dict(_INFINITE),
                "liveliness": "automatic",
                "liveliness_lease_duration": dict(_INFINITE),
                "avoid_ros_namespace_conventions": False,
            }
        ]

    @cache  # noqa: B019 - a handful of values, as long as the process
    def as_yaml(self) -> str:
        """The same list as text, as it stands in the MCAP channel's metadata."""
        return str(yaml.safe_dump(self.as_profiles(), sort_keys=False)).rstrip()


def _named(policy: str, value: object) -> str:
    return _POLICIES[policy][value - 1] if isinstance(value, int) else str(value)
