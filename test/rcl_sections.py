"""The parameters that a node takes from files, by the rules of rcl and rclpy."""

import re
from pathlib import Path

from straightcomp_ros.parameters.yaml_text import node_sections


def taken(node, files):
    """Parameters of a node, by its full name: rcl joins sections of one key at the place of the first, and rclpy goes
    through them in this order."""
    joined = {}
    for file in files:
        for key, given in node_sections(Path(file)):
            joined.setdefault(re.sub("/+", "/", f"/{key}"), {}).update(given)
    matching = [given for key, given in joined.items() if re.fullmatch(key.replace("/*", r"(/\w+)"), node)]
    return {name: value for given in matching for name, value in given.items()}
