"""Plays recorded samples to the real feedforward, controller and logger, without a driver."""

import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.analysis.interruption import played
from straightcomp_ros.bags.folder import opened
from straightcomp_ros.bags.reader import StreamColumns, read_attachments, read_streams, streams_of_stage
from straightcomp_ros.bags.recorded_nodes import parameters_of, replayed_map
from straightcomp_ros.cell.launcher import SLACK_S, Graph, LaunchError, exit_words, free_domain
from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import as_parameter_file

_PLAYED_TO = ("feedforward", "controller", "logger")
_NAMESPACE = "replay"
_LEARNED = "learning.file"
"""The only parameter of feedforward and controller that names a file which they write."""


@dataclass(frozen=True)
class GraphReplay:
    """Result of a replay: the bag recorded of it, the samples in the played bag, how many have a command in both bags,
    and how many of those have the same command to the bit, or not."""

    bag: Path
    samples: int
    commands: int
    equal: int
    different: int


def replay_through_graph(
    bag: Path,
    output: Path,
    remap: Mapping[str, str] | None = None,
    given: Mapping[str, Mapping[str, Any]] | None = None,
) -> GraphReplay:
    """Play a bag to the graph, with the parameters and the map that are attached to it, and compare the commands.

    The controller waits for each sample's reference (trigger ``lockstep``): its answers then depend on the samples
    alone, not on this machine's speed.

    The nodes are in a namespace and a ROS domain of their own, so that no running driver receives their commands. They
    write to the output folder only: a table that was learned is read from a copy.

    ``output`` is the folder for ``bag/`` and ``logs/``, in which there must be no bag; ``remap`` and ``given`` as of
    :func:`~straightcomp_ros.offline.audit.audit`.

    Raises:
        BagError: the bag is refused.
        LaunchError: a node could not be started, or failed.
    """
    with opened(bag) as files:
        streams = streams_of_stage(bag, files, (ENCODER, COMMAND), remap)
    attachments = read_attachments(bag)
    recorded = parameters_of(bag, attachments, given, remap)
    stamps = streams[ENCODER.topic].stamp if ENCODER.topic in streams else np.zeros(1, np.int64)
    duration = float(played(stamps)[-1]) * 1e-9
    new = output / "bag"
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        values = {name: _of_no_machine(recorded.get(name, {}), Path(folder)) for name in _PLAYED_TO[:2]}
        if survey := replayed_map(bag, attachments, recorded, Path(folder)):
            values["feedforward"]["stage.guide.file"] = str(survey)
        values["controller"]["trigger"] = "lockstep"
        # No machine follows these commands.
        values["controller"]["control.margins"] = "warn"
        values["player"] = {
            "bag": str(Path(bag).absolute()),
            "topic": (remap or {}).get(ENCODER.topic, ENCODER.topic),
            "subscribers": len(_PLAYED_TO),
            "ahead": 50,
            "start_timeout": SLACK_S,  # a node that ends meanwhile is seen
        }
        values["logger"] = {"output": str(new), "nodes": "feedforward controller"}
        file = Path(folder) / "parameters.yaml"
        write_whole(file, as_parameter_file(values))
        _play(file, output / "logs", duration)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        answers = read_streams(new, {COMMAND.topic: COMMAND.layout}).get(COMMAND.topic)
    before, after = _by_stamp(streams.get(COMMAND.topic)), _by_stamp(answers)
    common = before.keys() & after.keys()
    equal = sum(before[stamp] == after[stamp] for stamp in common)
    return GraphReplay(new, len(stamps), len(common), equal, len(common) - equal)


def _of_no_machine(recorded: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Recorded parameters of a node without what reaches the machine that was recorded.

    Nothing is late here, so that the node needs no CPUs of a machine that runs. What the node writes, it writes into
    ``folder``.
    """
    values = {name: value for name, value in recorded.items() if not name.startswith("realtime.")}
    if learned := values.get(_LEARNED):
        copy = folder / "learned.csv"
        if Path(str(learned)).is_file():
            shutil.copyfile(str(learned), copy)
        values[_LEARNED] = str(copy)
    return values


def _play(parameter_file: Path, logs: Path, duration: float) -> None:
    environment = {**os.environ, "ROS_DOMAIN_ID": free_domain(), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with Graph(logs, environment, namespace=_NAMESPACE) as graph:
        for name in _PLAYED_TO:
            graph.start(name, {}, parameter_file)
        player = graph.start("player", {}, parameter_file)
        deadline = time.monotonic() + duration + SLACK_S
        while player.poll() is None:
            graph.check(_PLAYED_TO)
            if time.monotonic() > deadline:
                raise LaunchError("the play did not end in time")
            time.sleep(0.05)
        if player.returncode != 0:
            raise LaunchError(f"player: {graph.last_words('player')}")
        code = graph.stop(_PLAYED_TO)["logger"]
        if code != 0:
            raise LaunchError(f"logger: {exit_words(code)}: {graph.last_words('logger')}")


def _by_stamp(stream: StreamColumns | None) -> dict[int, bytes]:
    if stream is None:
        return {}
    return dict(zip(stream.stamp.tolist(), map(bytes, stream.columns["control_current"]), strict=True))
