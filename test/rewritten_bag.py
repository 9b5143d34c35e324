"""Bags made from a recorded one by a change of its messages."""

from functools import lru_cache
from pathlib import Path

from mcap.reader import make_reader

from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import BagWriter
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
    (path,) = source.glob("*.mcap")
    begin, messages = None, []
    with path.open("rb") as file, BagWriter(folder, compression="none") as bag:
        reader = make_reader(file)
        for one in reader.iter_attachments():
            if (data := edit(one.name, one.data)) is not None:
                bag.attach(one.name, one.media_type, data, one.create_time)
        for one in reader.iter_metadata():
            bag.add_metadata(one.name, one.metadata)
        for schema, channel, message in _messages(path):
            topic, data, log_time = channel.topic, message.data, message.log_time
            if topic not in bag.topics:
                bag.add(Topic(topic, schema.name))
            if topic in _STREAMS:
                layout = _STREAMS[topic].layout
                stamp, numbers = layout.unpack(data)
                begin = stamp if begin is None else begin
                changed = change(topic[1:], stamp - begin, list(numbers))
                if changed is None:
                    continue
                new, numbers, *times = changed
                # A jump back by days must not end before 1970.
                new += begin if begin + new >= 0 else 0
                log_time = max(0, begin + times[0]) if times else log_time
                data = layout.pack(new, *numbers)
            messages.append((topic, data, log_time, log_time))
        # In parts: those of the first begin the file one by one, the others are written together.
        for at in range(0, len(messages), 1000):
            bag.write_all(messages[at : at + 1000])
    return folder
