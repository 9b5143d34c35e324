"""The cell's state machine on a machine that carries out each request within a tick."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from straightcomp_ros.cell.cell_sequence import CellSequence, StageMovements, check_strokes
from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import ACCEPTED, DONE, FAILED, ORDERED_IN, Command, Order, State
from straightcomp_ros.messages.joint_trajectory import MOST_POINTS
from straightcomp_ros.model.converters import nearest_count
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, forward_and_back, jog
from straightcomp_ros.model.paced_motion import PacedMotion, StageState
from straightcomp_ros.parameters.declaration import ParameterError

MOTION = MotionParameters(stroke=0.1, settle=0.2, pause=0.1)
TICK_S = 0.05
AT_REST_WITHOUT_CURRENT = (State.STOPPED, State.IDLE, State.COMPLETE, State.ABORTED)


class Bench:
    """A graph that carries out requests at once, unless ``obeys`` is False, and a clock that ticks by hand.

    Motions begin ``begins_after`` (s); ``trips`` are faults that come in turn when the amplifier is switched on."""

    def __init__(self, count=1e-7, begins_after=0.0, **options) -> None:
        self.now, self.obstacle = 100.0, ""
        self.obeys, self.begins_after, self.trips = True, begins_after, []
        self.moves, self.coming, self.requests, self.ended = [], [], [], 0
        self.answers, self.centred, self.centerings = [], True, []
        self.seen = Observation(nodes={"driver": "inactive"}, fresh=True, x=0.0, stamp_ns=1)
        self.motion, self.count = PacedMotion(MOTION, count=count), count
        self.sequence = CellSequence(self, MOTION, 5.0, clock=lambda: self.now, count=count, **options)

    def see(self, **changes):
        self.seen = replace(self.seen, **changes)

    def activate(self):
        self.see(nodes={"driver": "active"})

    def request(self, service, on=None, then=lambda refusal: None):
        refusal = ""
        if service == "driver/enable":
            self.requests.append("on" if on else "off")
            if on and self.trips:
                return self.see(faults=self.trips.pop())
            refusal = "" if self.obeys or not on else "not today"
            self.see(amplifier_on=bool(on) and (self.seen.amplifier_on or self.obeys))
        elif service == "driver/reset_fault":
            self.see(faults={} if self.obeys else self.seen.faults)
        elif service == "driver/home":
            self.see(unreferenced=self.seen.unreferenced if self.motion.pace.hold else "")
        elif service == "driver/hold":
            self.motion.ask(self.motion.pace._replace(hold=on))
        elif service == "driver/end_motion":
            self.ended += self.sequence.state in (State.EXECUTE, State.ABORTING)
            self.motion.ask(self.motion.pace._replace(end=True))
        elif service == "feedforward/center":
            return self.center(on, then)
        else:
            return self.answers.append(then)
        return then(refusal)

    def move(self, waypoints):
        assert waypoints[0].position == self.seen.x
        self.moves.append((self.now + waypoints[-1].time_ns * 1e-9, waypoints[-1].position))
        self.coming.append((self.now + self.begins_after, waypoints))
        self.begin_what_is_due()

    def begin_what_is_due(self):
        while self.coming and self.now >= self.coming[0][0]:
            self.begin(self.coming.pop(0)[1])

    def begin(self, waypoints):
        """As another client of the driver."""
        self.motion.begin(Trajectory(waypoints), round(self.now * 1e9))

    def override(self, fraction, then):
        self.motion.ask(self.motion.pace._replace(override=fraction))
        then("")

    def center(self, middle, then):
        self.centerings.append(middle)
        if self.sequence.state in (State.RESETTING, State.STARTING):
            self.centred = middle
            then("")
        else:
            self.answers.append(then)

    def ordered(self, order, argument=0, refusal=""):
        """Whether an order was accepted here, and then by the node unless that gives a ``refusal``."""
        got = []
        self.sequence.order(order, argument, got.append)
        if not got:
            self.answers.pop()(refusal)
        return got == [""]

    def tick(self):
        self.begin_what_is_due()
        self.now += TICK_S
        now_ns = round(self.now * 1e9)
        x = nearest_count(self.count, self.motion.position(now_ns))
        self.see(stamp_ns=now_ns, x=x, still=abs(x - self.seen.x) < 5e-5, stage=self.motion.state())
        self.sequence.tick(self.seen)

    def ticks(self, count):
        for _ in range(count):
            self.tick()

    def until(self, state, seconds=30.0):
        """Tick until the state comes; returns the states on the way, each once in a row."""
        way, end = [self.sequence.state], self.now + seconds
        while self.sequence.state is not state:
            assert self.now < end, way
            self.tick()
            if self.sequence.state is not way[-1]:
                way.append(self.sequence.state)
        return way

    def idle(self):
        assert self.give(Command.RESET, State.IDLE) == [State.RESETTING, State.IDLE]

    def give(self, command, state, strokes=0):
        """Give a command that is accepted; returns the states on the way to ``state``."""
        assert not self.sequence.command(command, strokes)
        return self.until(state)


def started(strokes, ticks=0, **options):
    """A bench whose sequence executes for so many ticks; 12 are the middle of its first movement."""
    bench = Bench(**options)
    bench.idle()
    bench.give(Command.START, State.EXECUTE, strokes)
    bench.ticks(ticks)
    return bench


COIL = {"driver": "coil burnt"}


# A count of 70 µm shows the stage 30 µm beyond its goal.
@pytest.mark.parametrize(
    ("as_one", "count", "movements"),
    [(False, 1e-7, [0.1, 0.0, 0.1, 0.0]), (False, 7e-5, [0.1, 0.0, 0.1, 0.0]), (True, 1e-7, [0.0])],
)
def test_a_cycle_runs_its_strokes_forward_and_back_and_ends_with_their_time_and_with_the_amplifier_off(
    as_one, count, movements
):
    bench = Bench(as_one=as_one, count=count)
    bench.idle()
    for strokes in (-1, 10**7):
        assert "allowed: 0 to" in bench.sequence.command(Command.START, strokes)
        assert bench.sequence.state is State.IDLE
    way = bench.give(Command.START, State.COMPLETE, 2)
    assert way == [State.STARTING, State.EXECUTE, State.COMPLETING, State.COMPLETE]
    assert [goal for _, goal in bench.moves] == movements and 0.0 <= bench.now - bench.moves[-1][0] < 0.5
    assert bench.sequence.movements.strokes_done == 2 and not bench.seen.amplifier_on


@pytest.mark.parametrize("changes", [{}, {"jerk": 20.0}, {"steps": 100}])
def test_as_many_strokes_are_accepted_as_one_trajectory_as_the_driver_takes_from_wherever_the_stage_stands(changes):
    motion, most = replace(MOTION, **changes), 0
    with pytest.raises(ParameterError, match=r"parameter 'strokes': .*allowed: <= "):
        while True:
            check_strokes(motion, most + 1)
            most += 1
    moves = StageMovements(motion, as_one=True)
    moves.begin(most)
    count = len(moves.next(Observation(x=0.05), 0.0))
    assert count <= MOST_POINTS < count + len(forward_and_back(motion)) + 8
    assert most >= 1000 or changes


@pytest.mark.parametrize("as_one", [False, True])
def test_hold_rests_in_mid_movement_with_the_amplifier_on_and_unhold_goes_on_with_the_same_one(as_one):
    bench = started(1, 12, as_one=as_one)
    way = bench.give(Command.HOLD, State.HELD)
    assert way == [State.HOLDING, State.HELD] and len(bench.moves) == 1
    assert 0.005 < bench.seen.x < 0.095 and bench.seen.amplifier_on and bench.seen.stage.condition == "held"
    stands = bench.seen.x
    bench.ticks(400)
    assert bench.seen.x == stands and bench.sequence.state is State.HELD
    way = bench.give(Command.UNHOLD, State.COMPLETE)
    assert way == [State.UNHOLDING, State.EXECUTE, State.COMPLETING, State.COMPLETE]
    assert len(bench.moves) == (1 if as_one else 2) and bench.seen.x == pytest.approx(0.0, abs=1e-9)
    bench = started(1, 12, as_one=as_one)
    assert bench.ordered(Order.OVERRIDE, 0)
    bench.give(Command.HOLD, State.HELD)
    # The next tick is late: the hold is taken back all the same.
    assert not bench.sequence.command(Command.UNHOLD)
    bench.now += 1.0
    assert bench.until(State.EXECUTE) and bench.ordered(Order.OVERRIDE, 100)
    bench.until(State.COMPLETE)


def test_stop_and_abort_end_the_movement_where_it_can_rest_or_leave_it_and_the_next_cycle_begins_there():
    for command, state, stands in ((Command.STOP, State.STOPPED, True), (Command.ABORT, State.ABORTED, False)):
        bench = started(3, 12, as_one=True)
        bench.give(command, state)
        assert (bench.seen.stage.condition == "rest") is stands and not bench.seen.amplifier_on
        if stands:
            assert 0.005 < bench.seen.x < 0.095
            bench.idle()
            bench.give(Command.START, State.COMPLETE, 1)
            assert bench.seen.x == pytest.approx(0.0, abs=1e-9)
    for command in (Command.STOP, Command.HOLD):
        # A fault that comes with the command does not let the stage go on.
        bench = started(3, 12, as_one=True, recoveries=1)
        bench.see(faults=COIL, amplifier_on=False)
        bench.give(command, State.ABORTED)
        bench.ticks(20)
        assert bench.seen.stage.condition == "rest" and 0.005 < bench.seen.x < 0.095


@pytest.mark.parametrize("strokes", [0, 1])
def test_a_motion_that_the_driver_begins_after_the_stop_is_not_left_without_compensation(strokes):
    bench = started(strokes, begins_after=12 * TICK_S)
    if not strokes:
        bench.sequence.order(Order.JOG, 1000, lambda refusal: None)
    bench.tick()
    assert bench.coming and not bench.sequence.command(Command.STOP)
    while bench.sequence.state is State.STOPPING:
        bench.tick()
        assert bench.seen.amplifier_on or bench.seen.stage.condition == "rest"
    assert bench.sequence.state is State.STOPPED and bench.motion.over and not bench.coming


@pytest.mark.parametrize("unseen", [{"fresh": False, "amplifier_on": False}, {"amplifier_on": False}])
def test_stop_asks_for_the_amplifier_off_though_it_seems_off_since_it_may_be_on_or_be_switched_on_yet(unseen):
    """Without samples, and while a slow driver has yet to answer a request to switch on."""
    bench = Bench()
    bench.idle()
    bench.obeys = False
    assert not bench.sequence.command(Command.START, 1)
    bench.tick()
    assert bench.requests[-1] == "on"
    bench.see(**unseen)
    bench.give(Command.STOP, State.STOPPED)
    assert bench.requests[-1] == "off"


def test_a_slower_movement_is_awaited_however_long_it_takes():
    bench = started(1)
    assert bench.ordered(Order.OVERRIDE, 5) and bench.motion.pace.override == 0.05
    bench.until(State.COMPLETE, 120.0)
    assert len(bench.moves) == 2
    assert not bench.ordered(Order.OVERRIDE, 101) and "0 to 100 %" in bench.sequence.message


def test_a_jog_moves_the_stage_while_the_platform_is_compensated_and_no_stroke_runs():
    bench = Bench()
    bench.give(Command.RESET, State.IDLE)
    assert not bench.ordered(Order.JOG, 100) and bench.sequence.message.endswith("accepted in: Execute")
    bench = started(1)
    assert not bench.ordered(Order.JOG, 100) and "0 strokes" in bench.sequence.message
    bench, answers = started(0), []
    bench.sequence.order(Order.JOG, -1000, answers.append)
    # Its answer is the driver's: the motion has begun.
    assert not answers and not bench.ordered(Order.JOG, 100) and "moves" in bench.sequence.message
    bench.tick()
    assert answers == [""]
    bench.ticks(20)
    assert bench.seen.x == pytest.approx(-1e-3, abs=1e-9)
    assert not bench.ordered(Order.JOG, 0) and "allowed" in bench.sequence.message
    bench.begins_after = math.inf
    bench.sequence.order(Order.JOG, 100, answers.append)
    bench.ticks(40)
    assert "did not begin" in answers[1] and bench.sequence.message == answers[1]
    # What has not begun may still wait: it must not begin later.
    assert bench.ended == 1
    bench.sequence.order(Order.JOG, 100, answers.append)
    bench.sequence.command(Command.ABORT)
    assert bench.ended == 2


@pytest.mark.parametrize(
    ("strokes", "movement", "after"),
    [
        (1, None, 0),
        # Another client's, with a rest that is longer than the settling time, and one that looks like rest.
        (0, forward_and_back(replace(MOTION, settle=1.0)), 0),
        (0, jog(replace(MOTION, speed=5e-4), 0.0, 1e-3), 0),
        # A jog that the driver begins after the command.
        (0, None, 15 * TICK_S),
    ],
)
def test_complete_switches_off_when_the_stage_has_stood_for_the_settling_time_and_not_on_its_way(
    strokes, movement, after
):
    bench = started(strokes, begins_after=after)
    if after:
        bench.sequence.order(Order.JOG, 1000, lambda refusal: None)
    elif movement:
        bench.begin(movement)
    bench.ticks(8)
    assert not bench.sequence.command(Command.COMPLETE)
    moved = bench.now
    while bench.sequence.state is State.COMPLETING:
        bench.tick()
        moved = bench.now if bench.seen.stage.condition == "moving" else moved
    assert bench.sequence.state is State.COMPLETE and bench.motion.over and not bench.coming
    assert MOTION.settle < bench.now - moved < MOTION.settle + 5 * TICK_S and not bench.seen.amplifier_on


OFF = {"amplifier_on": False}
DEAD = {"nodes": {"driver": "active", "controller": "silent"}}


@pytest.mark.parametrize(
    ("recoveries", "troubles", "hindrance", "recovered", "words"),
    [
        (2, [{"faults": COIL}], {}, 0, "driver: coil burnt"),
        (2, [DEAD], {}, 0, "controller (silent)"),
        (2, [{"nodes": {"driver": "silent"}}], {}, 0, "driver (silent)"),
        (2, [{"fresh": False} | OFF], {}, 0, "no samples"),
        (0, [OFF], {}, 0, "amplifier went off"),
        (2, [OFF, OFF, OFF], {}, 2, "amplifier went off"),
        # A fault while the amplifier is switched on again is recovered from as another one.
        (2, [{"faults": COIL} | OFF], {"trips": [COIL, COIL]}, 2, "driver: coil burnt"),
        (2, [{"faults": COIL} | OFF], {"obeys": False}, 1, "the fault remains: driver: coil burnt"),
        (2, [{"faults": COIL} | OFF, DEAD], {"obeys": False}, 1, "controller (silent)"),
    ],
)
def test_trouble_while_executing_that_cannot_be_recovered_from_aborts_with_the_reason(
    recoveries, troubles, hindrance, recovered, words
):
    bench = started(1, as_one=True, recoveries=recoveries)
    vars(bench).update(hindrance)
    for trouble in troubles:
        bench.see(**trouble)
        began = bench.now
        bench.ticks(5)
    bench.until(State.ABORTED)
    assert words in bench.sequence.message and bench.sequence.recovered == recovered
    assert bench.requests[-1] == "off" and not bench.seen.amplifier_on
    # At once when a node has died, since it cannot be switched on again.
    assert bench.sequence.since - began < (0.1 + 3 * TICK_S if troubles[-1] is DEAD else 10.0)


@pytest.mark.parametrize(("fault", "trips"), [(COIL, []), ({}, []), ({}, [COIL]), (COIL, [COIL, COIL])])
def test_an_amplifier_that_goes_off_in_mid_cycle_is_switched_on_again_as_often_as_that_is_allowed(fault, trips):
    bench = started(1, as_one=True, recoveries=3)
    bench.trips = [*trips]
    bench.tick()
    bench.see(faults=fault, amplifier_on=False)
    bench.ticks(15)
    assert bench.sequence.state is State.EXECUTE and bench.seen.amplifier_on and not bench.seen.faults
    assert bench.sequence.recovered == 1 + len(trips)
    bench.until(State.COMPLETE)
    assert len(bench.moves) == 1


def test_a_machine_that_is_idle_has_a_reference_of_x_and_its_amplifier_off_however_it_was_left():
    bench = Bench()
    bench.see(unreferenced="it was switched off", amplifier_on=True)
    bench.see(nodes={"driver": "active"}, stamp_ns=0)
    bench.sequence.command(Command.RESET)
    for _ in range(100):
        # Without a sample there may be no machine.
        bench.now += TICK_S
        bench.sequence.tick(bench.seen)
    assert bench.seen.unreferenced and bench.seen.unreferenced in bench.sequence.message
    bench.until(State.IDLE)
    assert bench.seen.unreferenced == "" and not bench.seen.amplifier_on


def test_a_stage_that_homes_for_longer_than_the_start_timeout_is_awaited_until_it_stands():
    bench = Bench()
    bench.see(unreferenced="the machine has not been homed")
    bench.begin(jog(MOTION, 0.0, 5.0))
    assert not bench.sequence.command(Command.RESET)
    bench.ticks(140)
    # At its index; from there it goes to the start.
    bench.see(unreferenced="")
    bench.ticks(140)
    assert bench.sequence.state is State.RESETTING and bench.seen.stage.condition == "moving"
    assert bench.until(State.IDLE) == [State.RESETTING, State.IDLE]


@pytest.mark.parametrize("way", [0.0, 0.01])
def test_a_stage_that_another_client_left_held_on_its_way_or_at_rest_is_let_go_to_home(way):
    bench = Bench()
    bench.see(unreferenced="the machine has not been homed")
    bench.request("driver/hold", True)
    if way:
        bench.begin(jog(MOTION, 0.0, way))
    bench.idle()


def test_a_homing_that_another_client_holds_stays_held():
    bench = Bench()
    bench.see(unreferenced="the machine has not been homed")
    request = bench.request

    def homing(service, *more):
        if service != "driver/home":
            request(service, *more)
        elif bench.motion.over:
            bench.begin(jog(MOTION, 0.0, 0.1))

    bench.request = homing
    assert not bench.sequence.command(Command.RESET)
    while bench.seen.x < 0.01:
        bench.tick()
    bench.request("driver/hold", True)
    assert bench.until(State.STOPPED) == [State.RESETTING, State.STOPPED]
    assert bench.seen.stage.condition == "held" and bench.seen.x < 0.09


def test_a_node_that_runs_and_is_starting_is_awaited_and_one_that_is_not_there_for_the_start_timeout_only():
    bench = Bench()
    bench.activate = lambda: None
    bench.see(nodes={"driver": "starting"})
    assert not bench.sequence.command(Command.RESET)
    bench.ticks(6000)
    assert bench.sequence.state is State.RESETTING and "driver (starting)" in bench.sequence.message
    assert bench.sequence.command(Command.START) == bench.sequence.message
    refusal = bench.sequence.message
    bench.ticks(3)
    assert bench.sequence.message == refusal and "waits" not in refusal
    bench.see(nodes={"driver": "active"})
    bench.until(State.IDLE, 2.0)
    bench.see(nodes={"driver": "absent"})
    assert not bench.sequence.command(Command.STOP)
    bench.until(State.STOPPED)
    bench.give(Command.RESET, State.STOPPED)
    assert "driver (absent)" in bench.sequence.message


def test_clear_resets_faults_and_gives_up_where_they_remain():
    bench = started(1)
    bench.see(faults=COIL)
    bench.until(State.ABORTED)
    bench.obeys = False
    bench.give(Command.CLEAR, State.ABORTED)
    assert "coil burnt" in bench.sequence.message
    bench.obeys = True
    bench.give(Command.CLEAR, State.STOPPED)


@pytest.mark.parametrize(
    ("hindrance", "words"),
    [
        ({"obeys": False}, "not today"),
        ({"center": lambda middle, then: then("not finished")}, "not finished"),
    ],
)
def test_a_node_that_refuses_at_the_start_stops_the_machine_with_its_words(hindrance, words):
    bench = Bench(home=True)
    bench.idle()
    vars(bench).update(hindrance)
    assert bench.give(Command.START, State.STOPPED, 1)[-2:] == [State.STOPPING, State.STOPPED]
    assert words in bench.sequence.message and not bench.seen.amplifier_on
    assert bench.obeys or bench.requests.count("on") > 2  # asked again


@pytest.mark.parametrize("as_one", [False, True])
def test_a_motion_that_the_driver_refuses_or_another_client_ends_or_replaces_or_that_ends_elsewhere_aborts(as_one):
    def end(bench):
        bench.motion.ask(bench.motion.pace._replace(end=True))

    def replace_it(bench):
        bench.begin(jog(MOTION, 0.0, 1e-3))

    def go_elsewhere(bench):
        position = bench.motion.position
        bench.motion.position = lambda now_ns: 0.9 * position(now_ns) + 1e-3

    # At rest before the first stroke it is ended where it may be to arrive.
    for begins_after, ticks, change, words in (
        (math.inf, 0, lambda bench: None, "did not begin"),
        (0.0, 7, end, "has ended"),
        (0.0, 2, end, "has ended"),
        (0.0, 2, replace_it, "has begun"),
        (0.0, 2, go_elsewhere, "did not arrive"),
    ):
        bench = started(2, ticks, as_one=as_one, begins_after=begins_after)
        change(bench)
        bench.until(State.ABORTED)
        assert words in bench.sequence.message and bench.sequence.movements.strokes_done == 0
        assert not bench.seen.amplifier_on


def test_a_stage_that_pauses_in_another_client_s_motion_is_awaited():
    bench = Bench()
    bench.begin([Waypoint(0, 0.0, 0.0), Waypoint(3_000_000_000, 0.0, 0.0)])
    bench.tick()
    assert bench.give(Command.RESET, State.IDLE) == [State.RESETTING, State.IDLE] and bench.now > 103.0


def test_faults_of_a_graph_that_others_run_change_nothing_while_stopped():
    bench = Bench()
    bench.see(faults=COIL, amplifier_on=True)
    bench.ticks(20)
    assert bench.sequence.state is State.STOPPED and not bench.requests


def test_orders_are_accepted_where_the_nodes_work_and_nothing_else_is_under_way():
    for order in (Order.RELOAD_MAP, Order.CENTER, Order.OVERRIDE):
        for state in State:
            bench = Bench()
            bench.sequence.state = state
            assert bench.ordered(order, 1) is (state in ORDERED_IN)
            assert bench.sequence.state is state
            if state not in ORDERED_IN:
                assert "Idle, Execute, Held, Complete" in bench.sequence.message


def test_what_a_node_refuses_is_said_and_changes_nothing():
    bench = Bench()
    bench.sequence.state = State.IDLE
    assert not bench.ordered(Order.CENTER, 1, refusal="not finished")
    assert bench.sequence.message == "not finished" and not bench.sequence.centred
    assert not bench.ordered(Order.RELOAD_MAP, refusal="no such file")
    assert bench.sequence.message == "no such file"


def test_with_the_reference_in_the_middle_no_stroke_begins_until_it_is_back():
    bench = started(2)
    assert not bench.ordered(Order.CENTER, 1)
    assert "while strokes are run" in bench.sequence.message
    bench.sequence.command(Command.HOLD)
    bench.until(State.HELD)
    assert bench.ordered(Order.CENTER, 1) and bench.sequence.centred
    assert "Center(false)" in bench.sequence.command(Command.UNHOLD) and bench.sequence.state is State.HELD
    assert bench.ordered(Order.CENTER, 0) and not bench.sequence.command(Command.UNHOLD)
    bench.until(State.COMPLETE)
    assert bench.ordered(Order.CENTER, 1)
    bench.idle()
    assert not bench.sequence.centred and not bench.centred
    # Nor does one begin before the answer; with 0 strokes it compensates until Complete.
    bench.sequence.order(Order.CENTER, True, lambda refusal: None)
    assert bench.sequence.command(Command.START, 1)
    bench.give(Command.START, State.EXECUTE, 0)
    bench.moves.clear()
    bench.ticks(200)
    assert bench.sequence.state is State.EXECUTE and not bench.moves
    bench.give(Command.COMPLETE, State.COMPLETE)


def test_in_lockstep_the_cycle_ends_though_no_sample_comes_before_the_motion_or_after_it():
    bench = Bench(as_one=True, home=True)
    bench.see(stamp_ns=0)
    first_ns, samples, lasts_ns = 10**18, [], []

    def lockstep():
        bench.now += TICK_S
        if lasts_ns:
            samples.append(min(len(samples) * 50_000_000, lasts_ns[0] - 500_000))
            bench.see(stamp_ns=first_ns + samples[-1], first_ns=first_ns, still=False, stage=StageState(number=1))
        bench.sequence.tick(bench.seen)

    bench.tick, bench.move = lockstep, lambda waypoints: lasts_ns.append(waypoints[-1].time_ns)
    bench.idle()
    bench.give(Command.START, State.EXECUTE, 1)
    assert bench.centerings and not any(bench.centerings)
    bench.until(State.COMPLETE)
    assert max(samples) < lasts_ns[0] and len(lasts_ns) == 1


def test_homing_takes_the_platform_to_the_middle_and_back_to_the_map_before_the_first_stroke():
    bench = Bench(home=True)
    bench.idle()
    bench.centerings.clear()
    began = bench.now
    bench.give(Command.START, State.EXECUTE, 1)
    assert bench.centerings == [True, False] and bench.now - began > 2.0 and not bench.moves


@pytest.mark.parametrize(
    ("obstacle", "seen", "within", "words"),
    [
        ("no node subscribes to the trajectory", {}, 6.0, "no node subscribes to the trajectory"),
        ("", {"descriptions": {"driver": "a 12", "controller": "b 34"}}, 2.0, "differ (controller b 34, driver a 12)"),
        ("", {"commissioning": "design", "amplifier_on": True}, 0.1, "being commissioned: design"),
    ],
)
def test_what_stands_in_the_way_of_resetting_ends_it_and_leaves_the_amplifier_as_it_is(obstacle, seen, within, words):
    bench = Bench()
    began = bench.now
    assert not bench.sequence.command(Command.RESET)
    bench.obstacle = obstacle
    bench.see(**seen)
    bench.until(State.STOPPED)
    assert words in bench.sequence.message and bench.now - began < within
    bench.ticks(3)
    assert bench.seen.amplifier_on is seen.get("amplifier_on", False) and not bench.requests


@given(
    st.lists(
        st.one_of(
            st.sampled_from(list(Command)),
            st.sampled_from([{"faults": {"driver": "x"}}, {"faults": {}}, {"fresh": False}, {"fresh": True}, {}]),
        ),
        max_size=40,
    )
)
@settings(max_examples=60, deadline=None)
def test_whatever_comes_only_transitions_of_the_tables_happen(events):
    bench = Bench()
    allowed = {(state, state) for state in State} | set(DONE.items()) | set(FAILED.items())
    allowed |= {(state, State.ABORTING) for state in State}
    # A state whose work is done at once is passed within a tick.
    allowed |= {(a, d) for a, b in allowed for c, d in DONE.items() if b is c}
    for event in events:
        before = bench.sequence.state
        if isinstance(event, Command):
            refused = bench.sequence.command(event, 1)
            assert bool(refused) == (before not in ACCEPTED[event])
            after = bench.sequence.state
            assert after is (before if refused else ACCEPTED[event][before])
        else:
            bench.see(**event)
        for _ in range(10):
            before = bench.sequence.state
            bench.tick()
            assert (before, bench.sequence.state) in allowed
            if before is bench.sequence.state and before in AT_REST_WITHOUT_CURRENT:
                assert not bench.seen.amplifier_on
    assert math.isfinite(bench.seen.x)


def test_while_the_machine_is_commissioned_no_cycle_begins_and_an_idle_cell_aborts():
    bench = Bench()
    bench.see(commissioning="identification")
    bench.tick()
    assert "identification" in bench.sequence.command(Command.RESET)
    assert bench.sequence.state is State.STOPPED and "on" not in bench.requests
    bench.see(commissioning="")
    bench.tick()
    bench.idle()
    bench.see(commissioning="connection")
    bench.until(State.ABORTED)
    assert "connection" in bench.sequence.message


def test_to_the_reason_of_an_abort_a_node_that_turns_out_dead_is_added_once_and_a_late_answer_is_not():
    bench = started(1)
    bench.sequence.order(Order.RELOAD_MAP, False, lambda refusal: None)
    bench.see(faults={"driver": "command_timeout: no command"})
    bench.until(State.ABORTED)
    bench.answers.pop()("")
    bench.see(nodes={"driver": "active", "controller": "silent"})
    bench.ticks(3)
    assert bench.sequence.message.startswith("driver: command_timeout: no command")
    assert bench.sequence.message.count("controller (silent)") == 1


@pytest.mark.parametrize("ends", [True, False])
def test_a_hold_during_a_recovery_brings_the_stage_to_rest_at_once_and_the_cycle_goes_on_if_the_fault_ends(ends):
    bench = started(1, 12, as_one=True, recoveries=1)
    bench.obeys = False
    bench.see(faults=COIL, amplifier_on=False)
    bench.tick()
    assert not bench.sequence.command(Command.HOLD)
    bench.ticks(20)
    assert bench.seen.stage.condition == "held" and 0.005 < (x := bench.seen.x) < 0.095
    bench.obeys = ends
    if not ends:
        bench.until(State.ABORTED)
        assert bench.sequence.message == "the fault remains: driver: coil burnt" and bench.motion.over
        return
    bench.until(State.HELD)
    assert bench.seen.amplifier_on and bench.seen.x == x
    bench.give(Command.UNHOLD, State.COMPLETE)
    assert len(bench.moves) == 1
