"""The driver as others see it: over its topics and services. One driver serves all tests."""

import json
import math
import time
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from parameters_of_tests import PATIENT
from participant import Follower, subscribe
from std_srvs.srv import SetBool

from straightcomp_ros.cell.launcher import verb_command
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, STAGE_STATE
from straightcomp_ros.messages.joint_trajectory import MOST_POINTS
from straightcomp_ros.model.motion import MotionParameters, Waypoint, jog
from straightcomp_ros.runtime.safety_panel import LATCHED
from straightcomp_ros.runtime.stage_state import stage_state
from straightcomp_ros.runtime.streams import StreamPublisher
from straightcomp_ros.safety.faults import Fault

pytestmark = pytest.mark.live

_APPLIED, _ENABLED = (DRIVER_STATE.layout.columns.index(name) for name in ("applied_current", "enabled"))


class Peer(Follower):
    """A stand-in for the controller, which answers each sample with ``current``; None: with no command."""

    def __init__(self):
        super().__init__("peer")
        self.states, self.current = [], 0.0
        self.command = StreamPublisher(self.node, COMMAND, at_once=True)
        subscribe(self.node, DRIVER_STATE, lambda _, numbers: self.states.append(numbers))

    def on_sample(self, stamp_ns, numbers):
        super().on_sample(stamp_ns, numbers)
        if self.current is not None:
            self.command(stamp_ns, self.current)


@pytest.fixture(scope="module")
def driver(shared_graph):
    shared_graph.start("driver", PATIENT)


@pytest.fixture
def peer(driver, own_domain):
    with Peer() as peer:
        # As the test before found it: off, and no fault.
        assert peer.enable(False).success
        peer.trigger("driver/reset_fault")
        peer.states.clear()
        yield peer


def foreign(peer):
    """One command stamped an hour ahead."""
    peer.command(peer.samples[-1][0] + 3600 * 10**9, 0.0)


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        (lambda peer: setattr(peer, "current", math.nan), Fault.COMMAND_NOT_FINITE),
        (lambda peer: setattr(peer, "current", None), Fault.COMMAND_TIMEOUT),
        (foreign, Fault.TWO_CONTROLLERS),
    ],
)
def test_a_wrong_command_or_none_ends_the_current_until_a_reset_which_forgets_it(peer, wrong, fault):
    peer.current = 0.02
    peer.switch_on()
    peer.until(lambda: peer.states and peer.states[-1][_APPLIED] > 0.01)
    wrong(peer)
    peer.until(lambda: not peer.amplifier_on())
    peer.until(lambda: peer.safety[-1].code == fault.code)
    assert all(math.isfinite(state[_APPLIED]) and abs(state[_APPLIED]) <= 1.0 for state in peer.states)
    peer.states.clear()
    peer.until(lambda: len(peer.states) > 20)
    # The first batch may have begun with the amplifier on.
    assert {state[_APPLIED] for state in peer.states if not state[_ENABLED]} == {0.0}
    peer.current = 0.0
    peer.spin(0.2)
    refusal = peer.enable()
    assert not refusal.success and fault.label in refusal.message
    assert peer.trigger("driver/reset_fault").success
    peer.switch_on()
    if fault is Fault.TWO_CONTROLLERS:
        assert peer.enable(False).success
        peer.current = None
        # For longer than the timeout: neither a stamp in the future nor an older command counts as fresh.
        peer.spin(1.0)
        answer = peer.enable()
        assert not answer.success and "no fresh command" in answer.message


def test_trajectories_that_no_stage_can_follow_are_refused_and_samples_still_come_on_the_clock_s_grid(peer):
    rest, second = Waypoint(0, 0.0, 0.0), 10**9
    peer.until(lambda: len(peer.samples) > 20)
    for *points, end in (
        [Waypoint(second, 1e300, 0.0)],
        [Waypoint(second, 1.7e308, 0.0), Waypoint(2 * second, -1.7e308, 0.0)],
        [Waypoint(1000, 1e-3, 0.0)],
        [Waypoint(k * 10**6, 0.0, 0.0) for k in range(1, MOST_POINTS + 1)],
    ):
        peer.move([rest, *points, end])
        seen = len(peer.samples)
        peer.until(lambda seen=seen: len(peer.samples) > seen + 20)
    assert {sample[0] for _, sample in peer.samples} == {0.0}
    assert len({stamp_ns % 5_000_000 for stamp_ns, _ in peer.samples}) == 1
    peer.move([rest, Waypoint(second, 1e-3, 0.0)])
    peer.until(lambda: peer.x == pytest.approx(1e-3))


def test_no_client_fills_the_log_with_what_is_refused_or_changes_nothing(peer, shared_graph):
    peer.until(lambda: len(peer.samples) > 20)
    peer.current = None
    # For longer than the timeout: one that is switched on meanwhile latches a fault, which is another answer.
    peer.spin(1.0)
    assert "no fresh command" in peer.enable().message
    lines, began = shared_graph.log("driver").read_text().count("\n"), time.monotonic()
    for _ in range(30):
        peer.move([Waypoint(0, 0.0, 0.0), Waypoint(10**9, 1e300, 0.0)])
        assert not peer.enable().success and peer.enable(False).success
    most = 2 * (2 + (time.monotonic() - began) // 5.0)
    assert shared_graph.log("driver").read_text().count("\n") - lines <= most


def test_a_motion_is_held_slowed_down_let_go_on_and_ended_with_the_amplifier_on(peer):
    peer.switch_on()
    states = []
    peer.node.create_subscription(DiagnosticStatus, STAGE_STATE, lambda one: states.append(stage_state(one)), LATCHED)

    def stands():
        seen = len(peer.samples)
        peer.until(lambda: len(peer.samples) > seen + 60)
        return len({sample[0] for _, sample in peer.samples[-50:]}) == 1

    def hold(on):
        assert peer.call(SetBool, "driver/hold", SetBool.Request(data=on)).success

    begin = peer.x
    peer.move(jog(MotionParameters(speed=0.05), begin, 0.05))
    peer.until(lambda: peer.x > begin + 0.01)
    hold(True)
    peer.until(lambda: states[-1].condition == "held")
    assert stands() and begin + 0.01 < peer.x < begin + 0.05 and peer.amplifier_on()
    assert peer.set("driver", {"override": 0.3}).successful
    hold(False)
    held = peer.x
    peer.until(lambda: peer.x > held + 0.002)
    assert states[-1].cut and states[-1].override == 0.3 and states[-1].behind_ns > 0
    assert peer.trigger("driver/end_motion").success
    peer.until(lambda: states[-1].condition == "rest")
    assert stands() and held < peer.x < begin + 0.05 and peer.amplifier_on()
    assert peer.set("driver", {"override": 1.0}).successful
    peer.move(jog(MotionParameters(), peer.x, -0.0001))
    peer.until(lambda: states[-1].condition == "rest" and not states[-1].cut)


@pytest.fixture
def page(shared_graph, peer, tmp_path):
    """The address of the live view of this driver, and the token of its buttons."""
    advice, limits = tmp_path / "gantry.json", tmp_path / "limits.yaml"
    advice.write_text(json.dumps({"stage": "a", "as_of": "2026-05-01", "advice": [{"text": "worn", "remedy": "mend"}]}))
    limits.write_text("encoder_pp_um: 0.6\ncontrol_rms_step_A: 0.1\n")
    command = verb_command("view", "--port", "0", "--maintenance", str(advice), "--limits", str(limits))
    view = shared_graph.start_program("view", command, read_output=True)
    yield view.stdout.readline().strip().split("#")
    shared_graph.stop(["view"])


def test_the_live_view_shows_the_driver_and_its_buttons_reach_it(page):
    address, token = page

    def press(action):
        headers = {"X-Token": token, "Content-Type": "application/json"}
        request = Request(f"{address}action", json.dumps({"action": action}).encode(), headers)
        with urlopen(request, timeout=30) as answer:
            return json.load(answer)["message"]

    slots, state, end = [], {}, time.monotonic() + 90
    with urlopen(f"{address}news", timeout=30) as news:
        while time.monotonic() < end and not (len(slots) > 5 and state["nodes"]["driver"]["rate_hz"]):
            line = news.readline()
            if line.startswith(b"data: "):
                shown = json.loads(line[6:])
                state = shown["state"]
                slots += shown["series"]["x"]
    assert state["fresh"] and not state["amplifier_on"]
    assert state["limit"] == {"um": 0.6, "source": "limits.yaml"} and state["faults"] == []
    assert state["maintenance"] == "as of 2026-05-01: worn; mend"
    assert state["nodes"]["driver"]["state"] != "absent" and state["nodes"]["logger"]["state"] == "absent"
    assert float(state["nodes"]["driver"]["rate_hz"]) > 0
    assert [slot[0] for slot in slots] == sorted({slot[0] for slot in slots})
    # No controller runs.
    with pytest.raises(HTTPError) as refused:
        press("enable")
    assert refused.value.code == 409
    assert (press("reset"), press("disable")) == ("faults reset", "amplifier off")
