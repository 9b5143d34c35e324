"""Bags after a power cut: a recorder's writes and syncs are logged, and replayed up to 1,000 moments.

At a cut the disk has all that was synced before; of what was written since then each sector of 512 bytes is there or
not, by chance, and so is each name. What is left is recovered by `straightcomp recover`. Printed: how much was lost,
from the last message that is there up to the cut. The exit code is 1 if that is more than a second, if a message before
it is missing, or if a bag that held more than a second cannot be recovered.
"""

import argparse
import contextlib
import os
import random
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from straightcomp_ros.bags import BagError, RecorderParameters, mcap_output
from straightcomp_ros.bags.reader import read_messages
from straightcomp_ros.bags.recorder import Recorder
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.topics import Topic, TopicQos
from straightcomp_ros.cli.options import in_range
from straightcomp_ros.cli.output import CommandFailed, print_json
from straightcomp_ros.contract import ENCODER
from trials.rig import tracked

SUMMARY = "what a power cut leaves of a bag"
_SECTOR = 512
_PERIOD_S = 0.5e-3
ALLOWED_S = 1.0


class Disk:
    """What reached the operating system, with times in s since the epoch: the creation of each file, its writes, each
    behind the last one, and the syncs of files and folders, begin and end."""

    def __init__(self) -> None:
        self.created: dict[str, float] = {}
        self.writes = defaultdict[str, list[tuple[float, bytes]]](list)
        self.syncs = defaultdict[str, list[tuple[float, float]]](list)

    def durable(self, path: str, cut: float) -> float:
        """Until when what was written of a file, or of a folder's names, was surely on the disk at the time ``cut``."""
        return max((begun for begun, ended in self.syncs[path] if ended <= cut), default=-1.0)

    def left(self, cut: float, chance: random.Random) -> dict[str, bytes]:
        """The files that a power cut at the time ``cut`` leaves, by path."""
        found = {}
        for path, created in self.created.items():
            named = self.durable(str(Path(path).parent), cut) >= created
            if created > cut or not (named or chance.random() < 0.5):
                continue
            durable, content, least = self.durable(path, cut), bytearray(), 0
            for at, data in self.writes[path]:
                if at <= durable:
                    content += data
                    least = len(content)
                elif at <= cut:
                    for start in range(0, len(data), _SECTOR):
                        part = data[start : start + _SECTOR]
                        content += part if chance.random() < 0.5 else bytes(len(part))
            # The length is brought to the disk with the data, or is that of an earlier moment.
            found[path] = bytes(content[: chance.randint(least, len(content))])
        return found


@contextlib.contextmanager
def logged() -> Iterator[Disk]:
    """Log what the block's recorders write and sync."""
    disk = Disk()

    def opened(path: Path, *words: Any, **options: Any) -> Any:
        file = open(path, *words, **options)  # noqa: SIM115 - closed by the recorder
        write, disk.created[str(path)] = file.write, time.time()

        def logging_write(data: Any) -> int:
            done = int(write(data))
            disk.writes[str(path)].append((time.time(), bytes(data[:done])))
            return done

        file.write = logging_write
        return file

    def logging(sync: Callable[[int], None]) -> Callable[[int], None]:
        def logging_sync(descriptor: int) -> None:
            begun, path = time.time(), os.readlink(f"/proc/self/fd/{descriptor}")
            sync(descriptor)
            disk.syncs[path].append((begun, time.time()))

        return logging_sync

    with (
        patch.object(mcap_output, "open", opened, create=True),
        patch.multiple(os, fsync=logging(os.fsync), fdatasync=logging(os.fdatasync)),
    ):
        yield disk


def record(folder: Path, seconds: float) -> tuple[Disk, float, float]:
    """Record encoder messages to the bag ``folder`` in real time; when the recording began and ended."""
    topic = Topic(f"/{ENCODER.topic}", ENCODER.layout.type_name, TopicQos("best_effort", depth=1000))
    recorder = Recorder(RecorderParameters(output=str(folder)), [topic.name], lambda bag, at_end: True)
    recorder.announce(topic)
    chance, number = np.random.default_rng(0), 0
    with logged() as disk:
        recorder.start()
        began = time.time()
        while (now := time.time()) < began + seconds:
            while began + number * _PERIOD_S <= now:
                stamp = round((began + number * _PERIOD_S) * 1e9)
                data = ENCODER.layout.pack(stamp, *chance.random(len(ENCODER.layout.columns)))
                recorder.intake.add(topic.name, data, stamp, stamp)
                number += 1
            time.sleep(0.02)
        ended = time.time()
        recorder.stop()
    return disk, began, ended


def cut_off(folder: Path, seconds: float, cuts: int) -> dict[str, Any]:
    """Record for some seconds, cut at ``cuts`` moments, and recover; what was lost."""
    disk, began, ended = record(folder / "bag", seconds)
    chance, lost, gaps, unreadable = random.Random(1), [], 0, 0
    syncs = [end - begun for path, spans in disk.syncs.items() if path.endswith(".mcap") for begun, end in spans]
    for _ in tracked(range(cuts), "cuts"):
        cut = began + chance.random() * (ended - began)
        with tempfile.TemporaryDirectory(dir=folder) as place:
            damaged, recovered = Path(place) / "bag", Path(place) / "recovered"
            damaged.mkdir()
            for path, data in disk.left(cut, chance).items():
                (damaged / Path(path).name).write_bytes(data)
            stamps = np.empty(0, np.int64)
            with contextlib.suppress(BagError):
                recover(damaged, recovered)
                stamps = np.sort(np.array(read_messages(recovered, f"/{ENCODER.topic}").log_time, np.int64))
        if not stamps.size:
            lost.append(cut - began)
            unreadable += cut - began > ALLOWED_S
            continue
        # Chunks behind a lost one may be there by chance.
        missing = np.flatnonzero(np.diff(stamps) * 1e-9 > 1.5 * _PERIOD_S)
        lost.append(cut - float(stamps[missing[0] if missing.size else -1]) * 1e-9)
        gaps += round(float(stamps[0]) * 1e-9 - began, 3) > _PERIOD_S
    quantiles = {f"lost_p{q}_s": round(float(np.percentile(lost, q)), 3) for q in (50, 99, 100)}
    return {
        "cuts": cuts,
        **quantiles,
        "more_than_allowed": int(np.sum(np.array(lost) > ALLOWED_S)),
        "unreadable": unreadable,
        "without_the_beginning": gaps,
        "syncs": len(syncs),
        "longest_sync_ms": round(max(syncs, default=0.0) * 1e3, 1),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=20.0, help="of recording (default: %(default)s)")
    kind = in_range(int, 1)
    parser.add_argument("--cuts", type=kind, default=1000, help="moments of a power cut (default: %(default)s)")


def run(options: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory(prefix="power_cuts_") as name:
        found = cut_off(Path(name), options.seconds, options.cuts)
    print_json(found)
    if found["more_than_allowed"] or found["unreadable"] or found["without_the_beginning"]:
        raise CommandFailed("a power cut took more than a second, or left a bag that cannot be read")
