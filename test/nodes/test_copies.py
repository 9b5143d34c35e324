"""Streams in bursts: each message comes once, whoever publishes."""

import time

import pytest
import rclpy
from rclpy.node import Node

from straightcomp_ros.contract import ENCODER
from straightcomp_ros.nodes.copies import BurstQueue, CopiedPublisher
from straightcomp_ros.nodes.streams import Inbox, unspun_node

PERIOD = 500_000


class Pair:
    """A reader that can wait, and the node that publishes for it."""

    def __init__(self):
        rclpy.init()
        self.reader, self.writer = Node("reader"), Node("writer")
        self.unspun = unspun_node(self.reader)
        self.queue = BurstQueue(self.reader, self.unspun, ENCODER)
        self.inbox = Inbox(self.reader, self.unspun, ENCODER, self.queue)
        self.stamps, self.sent = [], 0

    def wait(self, condition):
        end = time.monotonic() + 60.0
        while not condition() and time.monotonic() < end:
            rclpy.spin_once(self.reader, timeout_sec=0.01)
            rclpy.spin_once(self.writer, timeout_sec=0.01)
            self.fetch()
        assert condition()

    def fetch(self):
        self.stamps += [stamp for stamp, _, _ in self.inbox.fetch()]

    def direct_readers(self):
        return self.writer.count_subscribers(ENCODER.topic)

    def send(self, publish, count):
        for _ in range(count):
            publish(self.sent * PERIOD, 0.0, 0.0, 0.0, 0.0)
            publish.copy()
            self.sent += 1
            if self.sent % 30 == 0:
                time.sleep(0.002)
                self.fetch()


@pytest.fixture
def pair():
    pair = Pair()
    yield pair
    for node in (pair.unspun, pair.reader, pair.writer):
        node.destroy_node()
    rclpy.try_shutdown()


def test_without_a_copy_the_stream_itself_is_read(pair):
    publish = CopiedPublisher(pair.writer, ENCODER, copied=False)
    pair.wait(lambda: pair.queue.connected and pair.direct_readers() == 1)
    time.sleep(0.5)
    pair.send(publish, 300)
    pair.wait(lambda: len(pair.stamps) == 300)
    assert pair.stamps == [k * PERIOD for k in range(300)]


def test_a_reader_goes_over_to_the_copy_and_has_each_message_once(pair):
    publish = CopiedPublisher(pair.writer, ENCODER, copied=True)
    pair.wait(lambda: pair.queue.connected and pair.direct_readers() == 1)
    time.sleep(0.5)
    pair.send(publish, 1000)
    pair.wait(lambda: len(pair.stamps) >= 1000)
    # What a burst still lacks comes with the next look of its timer.
    assert pair.stamps == [k * PERIOD for k in range(1000)]
    pair.wait(lambda: pair.direct_readers() == 0)


def test_when_the_copy_s_publisher_goes_the_stream_itself_is_read_again(pair):
    publish = CopiedPublisher(pair.writer, ENCODER, copied=True)
    pair.wait(lambda: pair.queue.connected and pair.direct_readers() == 1)
    time.sleep(0.5)
    pair.send(publish, 100)
    pair.wait(lambda: len(pair.stamps) >= 100 and pair.direct_readers() == 0)
    for publisher in list(pair.writer.publishers):
        pair.writer.destroy_publisher(publisher)
    another = CopiedPublisher(pair.writer, ENCODER, copied=False)
    pair.wait(lambda: pair.direct_readers() == 1)
    time.sleep(0.5)
    pair.send(another, 100)
    pair.wait(lambda: len(pair.stamps) >= 200)
    assert pair.stamps == [k * PERIOD for k in range(200)]
