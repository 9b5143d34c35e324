"""Whatever comes over the network, no node ends, and the amplifier goes off by a stated fault only.

What is attacked is read from the running graph, so that a new subscription or service is attacked too.
"""

import itertools
import random
import sys
from importlib import import_module

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from parameters_of_tests import without_priority
from participant import Participant
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message

from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.cell.launcher import RECORDED, verb_command
from straightcomp_ros.contract import SAFETY_STATE, STREAMS
from straightcomp_ros.messages.cdr import pack_batch
from straightcomp_ros.runtime.graph_client import Heartbeats
from straightcomp_ros.runtime.safety_panel import SafetyState

FLOATS = (float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324, 0.0, -1.0)
WORDS = ("", "n/a", "nan", "-1", "1e400", "9" * 5000, "٣", "\u202e\u0000x", "ü" * 300, "🜚", "x" * 100_000, "[/x]%s%n")
NAMES = (
    *("stage_x", "platform_y", *RECORDED, "condition", "samples", "lost_samples"),
    *("code", "on", "fault", "stage", "active", "command_timeout", "control.law", "watch.travel", "stage.rate"),
)
WIDTHS = {"int8": 7, "uint8": 8, "int16": 15, "uint16": 16, "int32": 31, "uint32": 32, "int64": 63, "uint64": 64}
LEGAL_TRANSITIONS = range(1, 8)
COMMANDS = {"commissioning": [sys.executable, "-m", "straightcomp_ros.tuning.graph.commissioning_node"]}


def interface(name):
    """The class of `std_msgs/msg/String` or `std_srvs/srv/Empty`."""
    package, sort, kind = name.split("/")
    return getattr(import_module(f"{package}.{sort}"), kind)


class Attacker:
    """Sends hostile messages and requests to all of the graph's entrances, by one seed."""

    def __init__(self, node, seed):
        self.node, self.draw = node, random.Random(seed)
        topics, services = {}, {}
        for name, namespace in node.get_node_names_and_namespaces():
            if name != node.get_name():
                topics |= dict(node.get_subscriber_names_and_types_by_node(name, namespace))
                services |= dict(node.get_service_names_and_types_by_node(name, namespace))
        self.publishers = [
            node.create_publisher(interface(kind), name, self._qos(name)) for name, (kind, *_) in sorted(topics.items())
        ]
        # A request without fields, or of a boolean alone, cannot be malformed.
        self.clients = [
            node.create_client(interface(kind), name)
            for name, (kind, *_) in sorted(services.items())
            if set(interface(kind).Request.get_fields_and_field_types().values()) - {"boolean"}
        ]

    def _qos(self, topic):
        """Offers all that a subscriber may ask for."""
        asked = [one.qos_profile for one in self.node.get_subscriptions_info_by_topic(topic)]
        lease = min((one.liveliness_lease_duration for one in asked), key=lambda lease: lease.nanoseconds)
        return QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL, liveliness_lease_duration=lease)

    def attack(self):
        entrance = self.draw.choice([*self.publishers, *self.clients])
        if entrance in self.clients:
            entrance.call_async(self.message(entrance.srv_type.Request()))
        elif self.draw.random() < 0.6:
            entrance.publish(self.malformed(entrance.msg_type))
        else:
            entrance.publish(self.message(entrance.msg_type()))

    def malformed(self, kind):
        """Bytes that are a message of the loop with wild values, or no message at all."""
        draw, stream = self.draw, self.draw.choice(STREAMS)
        stamp = draw.choice((0, -1, -(2**31) * 10**9, (2**31 - 1) * 10**9, 1_800_000_000 * 10**9))
        data = stream.layout.pack(stamp, *(draw.choice(FLOATS) for _ in stream.layout.columns))
        if kind.__name__ == "UInt8MultiArray":
            data = pack_batch([(draw.choice((0, -1, 2**62)), data)] * draw.choice((0, 1, 64)))
        elif draw.random() < 0.5:
            data = serialize_message(self.message(kind()))
        data, at = bytearray(data), draw.randrange(len(data))
        way = draw.randrange(5)
        if way == 1:
            del data[at:]
        elif way == 2:
            data[at : at + 4] = draw.choice((b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\0"))
        elif way == 3:
            data = bytearray(draw.randbytes(draw.choice((0, 1, 4, 11, 12, 500))))
        elif way == 4:
            data += draw.randbytes(draw.choice((1, 7, 1000)))
        return bytes(data)

    def message(self, message):
        """The message of the right type with hostile values."""
        for name, kind in message.get_fields_and_field_types().items():
            setattr(message, name, self.value(kind))
        if type(message).__name__ == "Transition" and message.id in LEGAL_TRANSITIONS:
            message.id = 0
        return message

    def value(self, kind):
        draw = self.draw
        element = kind.partition("<")[2].rpartition(">")[0].partition(",")[0] if kind.startswith("sequence") else ""
        if element or kind.endswith("]"):
            count = draw.choice((0, 1, 2, 3, 200)) if element else int(kind.rpartition("[")[2][:-1])
            values = [self.value(element or kind.rpartition("[")[0]) for _ in range(count)]
            return b"".join(values) and values if element in ("byte", "octet") else values
        if kind in ("double", "float"):
            return draw.choice(FLOATS) if kind == "double" else draw.choice((float("nan"), float("inf"), 0.0))
        if kind in WIDTHS:
            low = 0 if kind.startswith("u") else -(2 ** WIDTHS[kind])
            return draw.choice((low, 2 ** WIDTHS[kind] - 1, 0, 3, max(low, -1)))
        if kind in ("byte", "octet"):
            return bytes([draw.choice((0, 2, 3, 255))])
        if kind.startswith(("string", "wstring")):
            return draw.choice(draw.choice((NAMES, WORDS)))
        return draw.random() < 0.5 if kind == "boolean" else self.message(interface(kind.replace("/", "/msg/"))())


def spin(participant, turns):
    for _ in range(turns):
        rclpy.spin_once(participant.node, timeout_sec=0.002)


# Less than this is asked of single callbacks in test_guarded_node.py.
@pytest.mark.nightly
@pytest.mark.keeps_time
def test_no_message_ends_a_node_and_the_amplifier_goes_off_by_stated_faults_only(graph, short_cycle, tmp_path):
    count = 2000
    pytest.importorskip("asyncua")
    from straightcomp_ros.opcua.admission import add_user

    add_user(tmp_path / "users", "plc1", "plcpassword1", "operator")
    output = {"logger": {"output": str(tmp_path / "bag")}, "commissioning": {"output": str(tmp_path / "steps")}}
    output["opcua"] = {"opcua.users": str(tmp_path / "users"), "opcua.port": free_port()}
    # A cell that waits for a node that never comes sees all that one in a cycle sees.
    output["cell"] = {"nodes": "driver feedforward controller logger player", "start_timeout": 600.0}
    nodes = (*RECORDED, "commissioning", "opcua", "cell")
    values = without_priority(short_cycle)
    processes = {
        name: graph.start(name, {**values.get(name, {}), **output.get(name, {})}, command=COMMANDS.get(name))
        for name in nodes
    }
    processes["view"] = graph.start_program("view", verb_command("view", "--port", "0"))
    with Participant("stranger") as stranger:
        heartbeats, states = Heartbeats(stranger.node, RECORDED), [SafetyState()]

        def on_state(message):
            # The attacker publishes there too.
            if message.hardware_id == "/driver" and message.message:
                states.append(SafetyState.of(message))

        def switched_on():
            stranger.trigger("driver/reset_fault")
            return stranger.enable().success

        every = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        stranger.node.create_subscription(DiagnosticStatus, SAFETY_STATE, on_state, every)
        # No executor of rclpy's own calls the steady timers of a Participant: age is not asked for here.
        stranger.until(lambda: set(heartbeats.states.values()) == {"active"})
        wanted = {*processes, "_view_subscriptions", "_opcua_subscriptions", "_cell_subscriptions"}
        stranger.until(lambda: wanted <= set(stranger.node.get_node_names()))
        spin(stranger, 300)
        attacker = Attacker(stranger.node, seed=count)
        # Eight nodes have six services of parameters each, and four of them one that changes their state.
        assert len(attacker.publishers) >= 14 and len(attacker.clients) >= 8 * 6 + 4
        stranger.until(switched_on)
        spin(stranger, 300)
        for number in range(count):
            attacker.attack()
            spin(stranger, 2)
            if number % 10 == 9:
                ended = {
                    one: graph.log(one).read_text()[-3000:] for one in processes if processes[one].poll() is not None
                }
                # A cell that was claimed the machine, or sees a fault, ends its cycle, and says so.
                assert not {name for name in ended if name != "cell" or "cycle failed: " not in ended[name]}, ended
                if not states[-1].amplifier_on:
                    switched_on()
        spin(stranger, 500)
        # They work still: each answers, and the loop can be switched on.
        stranger.until(switched_on)
        for before, after in itertools.pairwise(states):
            assert after.amplifier_on or after.fault or not before.amplifier_on
    for name, process in processes.items():
        assert process.poll() is None or (name, process.poll()) == ("cell", 1), name
        log = graph.log(name)
        assert log.stat().st_size < 1_000_000 and "Traceback" not in log.read_text(), name
