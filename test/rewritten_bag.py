"""Bags made from a recorded one by a change of its messages."""

from functools import lru_cache
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from straightcomp_ros.contract import STREAMS

_STREAMS = {f"/{stream.topic}": stream for stream in STREAMS}


# One bag is the source of many: to read it takes as long as all the rest.
@lru_cache(maxsize=2)
def _messages(path: Path) -> list[tuple]:
    with path.open("rb") as file:
        return list(make_reader(file).iter_messages())


def rewritten(source: Path, folder: Path, change, edit=lambda name, data: data) -> Path:
    """A copy of the only file of the bag ``source`` as ``folder``. ``change`` takes topic, stamp in ns from the first
    and numbers of a message of ours, and returns stamp and numbers, with the time of recording if that is another; or
    None to leave the message out. ``edit`` takes name and bytes of an attachment, and returns its bytes, or None."""
    folder.mkdir()
    (path,) = source.glob("*.mcap")
    with path.open("rb") as file, (folder / f"{folder.name}_0.mcap").open("wb") as target:
        reader, writer = make_reader(file), Writer(target, compression=CompressionType.NONE)
        writer.start("ros2")
        for one in reader.iter_attachments():
            if (data := edit(one.name, one.data)) is not None:
                writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, data)
        for one in reader.iter_metadata():
            writer.add_metadata(one.name, one.metadata)
        channels: dict[int, int] = {}
        begin = None
        for schema, channel, message in _messages(path):
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number, channel.metadata)
            data, log_time = message.data, message.log_time
            if channel.topic in _STREAMS:
                layout = _STREAMS[channel.topic].layout
                stamp, numbers = layout.unpack(data)
                begin = stamp if begin is None else begin
                changed = change(channel.topic[1:], stamp - begin, list(numbers))
                if changed is None:
                    continue
                new, numbers, *times = changed
                # A jump back by days must not end before 1970.
                new += begin if begin + new >= 0 else 0
                log_time = max(0, begin + times[0]) if times else log_time
                data = layout.pack(new, *numbers)
            writer.add_message(channels[channel.id], log_time, data, log_time)
        writer.finish()
    return folder
