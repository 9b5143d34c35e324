"""Bags after a power cut: a recorder's writes and syncs are logged, and replayed up to 1,000 moments.

    python -m trials power_cuts --seconds 20 --cuts 1000

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
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.bags import BagError, RecorderParameters, mcap_output
from straightcomp_ros.bags.reader import read_messages
from straightcomp_ros.bags.recorder import Recorder
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.topics import Topic, TopicQos
from straightcomp_ros.cli.output import CommandFailed, print_json
from straightcomp_ros.contract import ENCODER

SUMMARY = "what a power cut leaves of a bag"
PURPOSE = "judge"
_SECTOR = 512
_PERIOD_S = 0.5e-3
ALLOWED_S = 1.0


class Event(NamedTuple):
    """What reached the operating system, in the order of time: a write (offset, data), a truncation (offset), a sync
    of a file or of a folder's names (begun at ``begun``), or a new name."""

    time: float
    kind: str
    path: str
    offset: int = 0
    data: bytes = b""
    begun: float = 0.0


class LoggedFile:
    """A raw file whose writes are logged."""

    def __init__(self, file: Any, events: list[Event]) -> None:
        self._file, self._events = file, events
        events.append(Event(time.time(), "name", str(file.name)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, data: Any) -> int:
        offset, done = self._file.tell(), int(self._file.write(data))
        self._events.append(Event(time.time(), "write", str(self._file.name), offset, bytes(data[:done])))
        return done

    def truncate(self, size: int) -> None:
        self._file.truncate(size)
        self._events.append(Event(time.time(), "truncate", str(self._file.name), size))


@contextlib.contextmanager
def logged() -> Iterator[list[Event]]:
    """Log what the block's recorders write and sync."""
    events: list[Event] = []
    raw: Any = open
    calls = {name: getattr(os, name) for name in ("fsync", "fdatasync")}

    def logging(call: Any) -> Any:
        def sync(descriptor: int) -> None:
            begun, path = time.time(), os.readlink(f"/proc/self/fd/{descriptor}")
            call(descriptor)
            events.append(Event(time.time(), "sync", path, begun=begun))

        return sync

    mcap_output.open = lambda *words, **options: LoggedFile(raw(*words, **options), events)  # type: ignore[attr-defined]
    for name, call in calls.items():
        setattr(os, name, logging(call))
    try:
        yield events
    finally:
        del mcap_output.open  # type: ignore[attr-defined]
        for name, call in calls.items():
            setattr(os, name, call)


def left_on_disk(events: list[Event], cut: float, chance: random.Random) -> dict[str, bytes]:
    """The files that a power cut at the time ``cut`` leaves, by path."""
    before = [one for one in events if one.time <= cut]
    found = {}
    for path in dict.fromkeys(one.path for one in before if one.kind == "name"):
        created = next(one.time for one in before if one.kind == "name" and one.path == path)
        synced = [one.begun for one in before if one.kind == "sync" and one.path == str(Path(path).parent)]
        if not any(begun >= created for begun in synced) and chance.random() >= 0.5:
            continue
        durable = max((one.begun for one in before if one.kind == "sync" and one.path == path), default=0.0)
        content = bytearray()
        for one in (one for one in before if one.path == path and one.kind in ("write", "truncate")):
            if one.kind == "truncate":
                del content[one.offset :]
                continue
            content += bytes(max(0, one.offset + len(one.data) - len(content)))
            for start in range(0, len(one.data), _SECTOR):
                if one.time <= durable or chance.random() < 0.5:
                    part = one.data[start : start + _SECTOR]
                    content[one.offset + start : one.offset + start + len(part)] = part
        # The length is brought to the disk with the data, or is that of an earlier moment.
        least = max(
            (one.offset + len(one.data) for one in before if one.path == path and one.time <= durable), default=0
        )
        found[path] = bytes(content[: chance.randint(min(least, len(content)), len(content))])
    return found


def record(folder: Path, seconds: float) -> tuple[list[Event], float]:
    """Record encoder messages to the bag ``folder`` in real time; the events, and when the recording began."""
    topic = Topic(f"/{ENCODER.topic}", ENCODER.layout.type_name, TopicQos("best_effort", depth=1000))
    recorder = Recorder(RecorderParameters(output=str(folder)), [topic.name], lambda bag, at_end: True)
    recorder.announce(topic)
    chance, number = np.random.default_rng(0), 0
    with logged() as events:
        recorder.start()
        began = time.time()
        while (now := time.time()) < began + seconds:
            while began + number * _PERIOD_S <= now:
                stamp = round((began + number * _PERIOD_S) * 1e9)
                data = ENCODER.layout.pack(stamp, *chance.random(len(ENCODER.layout.columns)))
                recorder.intake.add(topic.name, data, stamp, stamp)
                number += 1
            time.sleep(0.02)
        taken = len(events)
        recorder.stop()
    return events[:taken], began


def cut_off(folder: Path, seconds: float, cuts: int, seed: int) -> dict[str, Any]:
    """Record for some seconds, cut at ``cuts`` moments, and recover; what was lost."""
    events, began = record(folder / "bag", seconds)
    chance, lost, gaps, unreadable = random.Random(seed), [], 0, 0
    syncs = [one.time - one.begun for one in events if one.kind == "sync" and one.path.endswith(".mcap")]
    for _ in range(cuts):
        cut = began + chance.random() * (events[-1].time - began)
        left = left_on_disk(events, cut, chance)
        with tempfile.TemporaryDirectory(dir=folder) as place:
            damaged = Path(place) / "bag"
            damaged.mkdir()
            for path, data in left.items():
                (damaged / Path(path).name).write_bytes(data)
            try:
                result = recover(damaged, Path(place) / "recovered")
                found = read_messages(Path(place) / "recovered", f"/{ENCODER.topic}")
                stamps = np.sort(np.array(found.log_time, np.int64))
            except BagError:
                result, stamps = None, np.empty(0)
            if result is None or not stamps.size:
                lost.append(cut - began)
                unreadable += cut - began > ALLOWED_S
                continue
            steps = np.diff(stamps) * 1e-9
            whole = int(np.argmax(steps > 1.5 * _PERIOD_S)) if (steps > 1.5 * _PERIOD_S).any() else stamps.size - 1
            # Chunks behind a lost one may be there by chance.
            lost.append(cut - float(stamps[whole]) * 1e-9)
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
    parser.add_argument("--cuts", type=int, default=1000, help="moments of a power cut (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of moments and sectors (default: %(default)s)")


def run(options: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory(prefix="power_cuts_") as name:
        found = cut_off(Path(name), options.seconds, options.cuts, options.seed)
    print_json(found)
    if found["more_than_allowed"] or found["unreadable"] or found["without_the_beginning"]:
        raise CommandFailed("a power cut took more than a second, or left a bag that cannot be read")
