"""metadata.yaml: what rosbag2 knows of a bag without opening its files. Version 9, as ROS 2 Jazzy writes it.

Source: rosbag2_storage/yaml.hpp, ``convert<BagMetadata>`` and ``convert<TopicMetadata>``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import yaml

from straightcomp_ros.bags.definitions import ROS_DISTRO
from straightcomp_ros.bags.qos import TopicQos

VERSION = 9
_NO_TIME = 2**63 - 1
"""Start of a bag without messages, in ns: rosbag2 writes the end of time."""


@dataclass(frozen=True)
class Topic:
    """A recorded topic: full name, ROS type, quality of service, type hash."""

    name: str
    type_name: str
    qos: TopicQos
    type_hash: str


def bag_information(
    file_name: str,
    topics: Sequence[tuple[Topic, int]],
    time_range: tuple[int, int] | None,
    custom_data: Mapping[str, str],
) -> dict[str, object]:
    """The content of metadata.yaml below its one root key.

    Args:
        file_name: the bag's one file, relative to its folder.
        topics: each topic with its number of messages.
        time_range: first and last log time in ns, None without messages.
        custom_data: free texts.
    """
    first, last = time_range or (_NO_TIME, _NO_TIME)
    starting_time, duration = {"nanoseconds_since_epoch": first}, {"nanoseconds": last - first}
    message_count = sum(count for _, count in topics)
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": starting_time,
        "message_count": message_count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": topic.qos.as_profiles(),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": count,
            }
            for topic, count in topics
        ],
        # Of rosbag2's own compression of messages and files; MCAP compresses its chunks by itself.
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [
            {
                "path": file_name,
                "starting_time": dict(starting_time),
                "duration": dict(duration),
                "message_count": message_count,
            }
        ],
        "custom_data": dict(custom_data) or None,
        "ros_distro": ROS_DISTRO,
    }


def as_yaml(information: Mapping[str, object]) -> str:
    """YAML without anchors, in the order of rosbag2."""
    return str(yaml.dump(dict(information), Dumper=_WithoutAnchors, sort_keys=False, allow_unicode=True))


class _WithoutAnchors(yaml.SafeDumper):
    """Writes an object that occurs twice two times, as yaml-cpp does."""

    def ignore_aliases(self, data: object) -> bool:
        return True
