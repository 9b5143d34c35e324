"""Many bags of several stages over months, made from one run: its messages with other stamps and readings."""

from functools import cache
from pathlib import Path

import numpy as np
from places import SMC

from straightcomp_ros.bags import PARAMETERS_ATTACHMENT
from straightcomp_ros.bags.information import ORIGIN_METADATA
from straightcomp_ros.bags.reader import StreamColumns, read_attachments, read_streams
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ALWAYS_PUBLISHED, ENCODER
from straightcomp_ros.messages.cdr import NANOSECONDS

FIRST_NS, STEP_NS = 1_760_000_000 * NANOSECONDS, 43_200 * NANOSECONDS
"""Stamp of the first bag's first sample, in October 2025, and from one bag of a stage to its next."""


@cache
def run() -> tuple[dict[str, StreamColumns], dict[str, bytes]]:
    """The streams of the run, and what is attached to its bag."""
    layouts = {stream.topic: stream.layout for stream in ALWAYS_PUBLISHED}
    return read_streams(SMC, layouts), read_attachments(SMC)


def write_bag(folder: Path, number: int, stages: int = 1, parameters: str | None = None, **split: float) -> None:
    """Write bag ``number``, from 0, of so many stages in turn, named by their numbers but for other ``parameters``;
    every number makes other messages, always the same. ``split`` is that of the writer."""
    streams, attachments = run()
    own = attachments[PARAMETERS_ATTACHMENT].decode().replace("name: synthetic", f"name: stage_{number % stages}")
    attachments = {**attachments, PARAMETERS_ATTACHMENT: (parameters or own).encode()}
    shift = FIRST_NS + number // stages * STEP_NS - int(streams[ENCODER.topic].stamp[0])
    random, messages = np.random.default_rng(number), []
    with BagWriter(folder, **split) as bag:
        for stream in ALWAYS_PUBLISHED:
            bag.add(Topic(f"/{stream.topic}", stream.layout.type_name))
            recorded, layout = streams[stream.topic], stream.layout
            rows = np.frombuffer(layout.pack(0, *(0.0 for _ in layout.columns)) * len(recorded), layout.dtype).copy()
            rows["sec"], rows["nanosec"] = np.divmod(recorded.stamp + shift, NANOSECONDS)
            for name, values in recorded.columns.items():
                # A count more or less in some readings of the platform.
                counts = random.choice((-1e-7, 0.0, 1e-7), values.size, p=(0.025, 0.95, 0.025))
                rows[name] = values + counts if (stream, name) == (ENCODER, "y") else values
            times = (recorded.log_time + shift).tolist()
            messages += [(f"/{stream.topic}", row.tobytes(), at, at) for row, at in zip(rows, times, strict=True)]
        for name, data in attachments.items():
            bag.attach(name, "", data)
        bag.add_metadata(ORIGIN_METADATA, {"version": "generated", "revision": "none"})
        messages.sort(key=lambda message: message[2])
        # In parts: those of the first begin the file one by one, the others are written together.
        for at in range(0, len(messages), 1000):
            bag.write_all(messages[at : at + 1000])
