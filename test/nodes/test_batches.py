"""Streams in batches: each message comes once, whoever publishes."""

import time

import pytest
import rclpy
from participant import Participant
from rclpy.node import Node

from straightcomp_ros.contract import ENCODER, TRUTH
from straightcomp_ros.runtime.intra_process import IntraProcess
from straightcomp_ros.runtime.streams import StreamPublisher, Streams, SubscriptionQueue

pytestmark = pytest.mark.live

PERIOD, NOUGHT = 500_000, [0.0] * len(TRUTH.layout.columns)


class Pair(Participant):
    """A reader that can wait, and the node that publishes for it."""

    def __init__(self):
        super().__init__("reader")
        self.writer, self.streams = Node("writer"), Streams(self.node)
        self.queue = self.streams.raw_batches(ENCODER)
        self.received = SubscriptionQueue(self.node, ENCODER, self.queue)
        self.stamps, self.sent = [], 0

    def wait(self, condition):
        def came():
            rclpy.spin_once(self.writer, timeout_sec=0.01)
            self.fetch()
            return condition()

        self.until(came)

    def connect(self, condition):
        """Wait for it, and until the middleware has connected what it has discovered."""
        self.wait(condition)
        time.sleep(0.2)

    def __exit__(self, *_):
        self.streams.close()
        self.writer.destroy_node()
        super().__exit__()

    def fetch(self):
        self.stamps += [stamp for stamp, _, _ in self.received.fetch()]

    def direct_readers(self):
        return self.writer.count_subscribers(ENCODER.topic)

    def send(self, publish, count):
        for _ in range(count):
            publish(self.sent * PERIOD, 0.0, 0.0, 0.0, 0.0)
            publish.publish_batch()
            self.sent += 1
            if self.sent % 30 == 0:
                time.sleep(0.002)
                self.fetch()


@pytest.fixture
def pair():
    with Pair() as pair:
        yield pair


def test_a_reader_has_each_message_once_whether_batches_come_go_or_never_were(pair):
    sent = 0
    for rate, count in ((None, 300), (2000, 1000), (None, 100)):
        # The reader of one by one is there again when the publisher of batches has gone.
        publish = StreamPublisher(pair.writer, ENCODER, rate, at_once=True)
        pair.connect(lambda: pair.queue.connected and pair.direct_readers() == 1)
        pair.send(publish, count)
        sent += count
        # What a batch still lacks comes with the next look of its timer.
        pair.wait(lambda sent=sent: len(pair.stamps) >= sent)
        assert pair.stamps == [k * PERIOD for k in range(sent)]
        if rate is not None:
            pair.wait(lambda: pair.direct_readers() == 0)
        for publisher in list(pair.writer.publishers):
            pair.writer.destroy_publisher(publisher)


def test_a_stream_that_no_loop_waits_for_comes_one_by_one_only_to_who_subscribes_to_it(pair):
    publish, received, seen = StreamPublisher(pair.writer, TRUTH, 2000), [], []
    batches = pair.streams.raw_batches(TRUTH)

    def send(numbers):
        for number in numbers:
            publish(number * PERIOD, *NOUGHT)
        publish.flush()

    def look():
        received.extend(TRUTH.layout.unpack(data)[0] // PERIOD for data, _ in batches.fetch())
        return received

    pair.connect(lambda: batches.connected and pair.writer.count_subscribers(TRUTH.topic) == 1)
    send(range(100))
    # Having had the first batch the reader leaves the stream itself, and no other node reads that.
    pair.wait(lambda: look() == list(range(100)) and pair.writer.count_subscribers(TRUTH.topic) == 0)
    direct = pair.streams.queue(TRUTH)
    pair.connect(lambda: pair.writer.count_subscribers(TRUTH.topic) == 1)
    send(range(100, 120))
    pair.wait(lambda: seen.extend(stamp // PERIOD for stamp, _, _ in direct.fetch()) or len(seen) == 20)
    assert seen == list(range(100, 120))
    pair.wait(lambda: look() == list(range(120)))


def test_a_message_of_a_batch_says_when_it_was_made_and_not_when_the_batch_went_out(pair):
    publish = StreamPublisher(pair.writer, TRUTH, None)
    batches = pair.streams.raw_batches(TRUTH)
    pair.connect(lambda: batches.connected)
    publish(0, *NOUGHT)
    publish.flush()
    first = []
    pair.wait(lambda: first.extend(batches.fetch()) or (first and not pair.writer.count_subscribers(TRUTH.topic)))
    made = []
    for k in range(1, 4):
        made.append(time.time_ns())
        publish(k * PERIOD, *NOUGHT)
        time.sleep(0.05)
    flushed = time.time_ns()
    publish.flush()
    messages = []
    pair.wait(lambda: messages.extend(batches.fetch()) or len(messages) >= 3)
    for (_, times), at in zip(messages, made, strict=True):
        assert at <= times["source_timestamp"] < at + 50_000_000
        assert times["received_timestamp"] >= flushed


def test_what_is_handed_over_in_memory_is_published_for_others_after_the_turn_of_the_loop(pair):
    shared = IntraProcess((ENCODER,))
    sender, receiver = (Streams(pair.writer, shared) for _ in range(2))
    queue, publish = receiver.queue(ENCODER), sender.publisher(ENCODER, 2000, at_once=True)
    pair.connect(lambda: pair.queue.connected)
    stamps = [k * PERIOD for k in range(100)]
    for stamp in stamps:
        publish(stamp, 0.0, 0.0, 0.0, 0.0)
        publish.publish_batch()
    assert [stamp for stamp, _, _ in queue.fetch()] == stamps
    pair.fetch()
    assert pair.stamps == []
    sender.publish_records()
    pair.wait(lambda: len(pair.stamps) >= len(stamps))
    assert pair.stamps == stamps
