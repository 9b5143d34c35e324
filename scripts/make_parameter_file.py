"""Writes config/straightcomp.yaml: every parameter of every node, from its declaration in the code."""

from pathlib import Path
from typing import Any

import yaml

from straightcomp_ros.configuration.node_parameters import NODE_PARAMETERS
from straightcomp_ros.settings.declaration import declarations

FILE = Path(__file__).resolve().parent.parent / "config" / "straightcomp.yaml"
LOOP = {"realtime.priority": 40, "realtime.cpus": "loop"}
REST = {"realtime.priority": 40, "realtime.cpus": "rest"}
CHANGED: dict[str, dict[str, Any]] = {
    "driver": {"simulated.command_timeout": 0.25, **LOOP, "realtime.keep_awake": True, "realtime.exclusive": True},
    "controller": LOOP,
    **dict.fromkeys(("feedforward", "logger", "cell", "opcua"), REST),
}
"""Values that differ from the default; the head of the file says why."""
HEAD = """\
# Parameters of all nodes of straightcomp_ros, for `--params-file` and for the launch files.
# Made by scripts/make_parameter_file.py from the declarations in the code; SI units.
# Some values differ from their defaults. realtime.priority asks for real-time scheduling; where it is not permitted the
# nodes say so and run without; all have the same, since they share locks, and one that is starved while it holds a
# lock stops the others. realtime.keep_awake halves the time that a CPU takes to wake up.
# realtime.cpus puts driver and controller on one CPU, where one wakes the other in a tenth of the time that it takes
# between two, and keeps the other nodes off it; a second stage on the same machine needs another CPU for its loop.
# realtime.exclusive keeps other programs off that CPU for as long as the driver runs.
# simulated.command_timeout is longer than the default of 5 ms: a desktop stalls for longer at times, and a simulated
# machine breaks nothing.
"""


def parameter_file() -> str:
    """Text of the file."""
    lines = [HEAD]
    for node, parameter_set in NODE_PARAMETERS.items():
        lines.append(f"/**/{node}:\n  ros__parameters:")
        for declaration in declarations(parameter_set):
            value = CHANGED.get(node, {}).get(declaration.name, declaration.default)
            unit = f" [{declaration.unit}]" if declaration.unit else ""
            lines.append(f"    # {declaration.description}{unit}; {declaration.allowed()}")
            lines.append(f"    {declaration.name}: {_as_yaml(value)}")
        lines.append("")
    return "\n".join(lines)


def _as_yaml(value: Any) -> str:
    # YAML 1.1 takes 1e-07 for a text: a float needs its point.
    if isinstance(value, float) and "e" in repr(value) and "." not in repr(value):
        return repr(value).replace("e", ".0e")
    return yaml.safe_dump(value, default_style='"' if isinstance(value, str) else None).splitlines()[0]


if __name__ == "__main__":
    FILE.write_text(parameter_file())
