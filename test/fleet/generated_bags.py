"""Many bags of several stages over months, made from one run: its messages with other stamps and readings."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.judged_motion import encoder_count
from straightcomp_ros.bags import MAP_ATTACHMENT, PARAMETERS_ATTACHMENT
from straightcomp_ros.bags.information import ORIGIN_METADATA
from straightcomp_ros.bags.reader import StreamColumns, read_attachments, read_streams
from straightcomp_ros.bags.writer import BagWriter, Message
from straightcomp_ros.contract import ALWAYS_PUBLISHED, ENCODER, Stream
from straightcomp_ros.messages.cdr import NANOSECONDS

FIRST_NS = 1_760_000_000_000_000_000
"""Stamp of the first bag's first sample: in October 2025."""
_STEP_NS = 43_200 * NANOSECONDS
"""From one bag of a stage to its next."""
_CHANGED = 0.05
"""Fraction of the samples whose y reads one count more or less than in the simulated run."""
_STAGE = b"stage.name: synthetic"


class Template(NamedTuple):
    """A run: its streams by topic, and the attachments of its bag."""

    streams: dict[str, StreamColumns]
    attachments: dict[str, bytes]


def template_of(bag: Path) -> Template:
    """A recorded run as a template; BagError when the bag cannot be read."""
    layouts = {stream.topic: stream.layout for stream in ALWAYS_PUBLISHED}
    return Template(read_streams(bag, layouts), read_attachments(bag))


def write_bag(template: Template, folder: Path, number: int, stages: int = 1) -> None:
    """Write bag ``number``, from 0, of so many stages in turn; every number makes other messages, always the same.

    Raises BagError when the folder holds files or cannot be written.
    """
    stage, turn = number % stages, number // stages
    parameters = template.attachments[PARAMETERS_ATTACHMENT].replace(_STAGE, f"stage.name: stage_{stage}".encode())
    start = int(template.streams[ENCODER.topic].stamp[0])
    shift = FIRST_NS + turn * _STEP_NS - start
    messages: list[Message] = []
    with BagWriter(folder) as bag:
        for stream in ALWAYS_PUBLISHED:
            bag.add_topic(f"/{stream.topic}", stream.layout.type_name)
            messages += _messages(stream, template.streams[stream.topic], shift, number)
        bag.attach(PARAMETERS_ATTACHMENT, "application/yaml", parameters)
        bag.attach(MAP_ATTACHMENT, "text/csv", template.attachments[MAP_ATTACHMENT])
        bag.add_metadata(ORIGIN_METADATA, {"version": "generated", "revision": "none"})
        bag.write_all(sorted(messages, key=lambda message: message[2]))


def _messages(stream: Stream, recorded: StreamColumns, shift_ns: int, seed: int) -> list[Message]:
    layout = stream.layout
    rows = np.frombuffer(layout.pack(0, *(0.0 for _ in layout.columns)) * len(recorded), layout.dtype).copy()
    stamps = recorded.stamp + shift_ns
    rows["sec"], rows["nanosec"] = stamps // NANOSECONDS, stamps % NANOSECONDS
    for name, values in recorded.columns.items():
        rows[name] = values + _counts(values, seed) if (stream, name) == (ENCODER, "y") else values
    data, size = rows.tobytes(), layout.size
    times = (recorded.log_time + shift_ns).tolist()
    return [(f"/{stream.topic}", data[n * size : (n + 1) * size], at, at) for n, at in enumerate(times)]


def _counts(readings: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """A count more or less in some readings (n,)."""
    random = np.random.default_rng(seed)
    chosen = random.random(readings.size) < _CHANGED
    count = encoder_count(readings)
    return np.where(chosen, count * random.choice((-1.0, 1.0), readings.size), 0.0)
