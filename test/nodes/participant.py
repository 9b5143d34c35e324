"""Somebody else in the graph: waits while it listens, and calls services."""

import time

import rclpy
from rclpy.node import Node

PATIENCE_S = 60.0


class Participant:
    """A node in this process, while it is entered as a context."""

    def __init__(self, name):
        rclpy.init()
        self.node = Node(name)
        self._clients = {}

    def until(self, condition, seconds=PATIENCE_S):
        end = time.monotonic() + seconds
        # Asked once in each turn: a condition may be a request, and a second one after it was granted may be refused.
        while not condition():
            assert time.monotonic() < end, "it never came true"
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def call(self, kind, name, request):
        client = self._clients.setdefault(name, self.node.create_client(kind, name))
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.node.destroy_node()
        rclpy.shutdown()
