"""What a working machine cannot do is found, and what it can do is not."""

import math
import random

import pytest

from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.model.motion import MotionParameters, StageLimits, Trajectory, forward_and_back
from straightcomp_ros.model.paced_motion import Pace, PacedMotion
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.watch import (
    ClockWatch,
    ErrorWatch,
    SampleWatch,
    StageWatch,
    WatchParameters,
    ZeroWatch,
    moving_current,
)
from straightcomp_ros.stage.description import StageParameters
from trials.faulty_machine import FaultyHardware

STAGE = StageParameters()
T = STAGE.period_ns
COUNT = 1e-7
COARSE = {"encoder.x_resolution": 1e-6}
TRAJECTORY = Trajectory(forward_and_back(MotionParameters()))
SECOND = 10**9


def watch(stage=STAGE, **parameters):
    return SampleWatch(WatchParameters(**parameters), stage)


def feed(found, number, x, y, current=0.0):
    """The finding of the sample with this number."""
    return found.check(Sample(number * T, x, y, 0.0), current)


def fed(samples, currents=None):
    """The first finding in samples of (x, y), and its place."""
    found = watch()
    findings = (feed(found, k, x, y, currents[k] if currents else 0.0) for k, (x, y) in enumerate(samples))
    return next(((place, finding[0]) for place, finding in enumerate(findings) if finding), None)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_sample_that_is_not_finite_is_found_in_x_and_in_y(bad):
    for samples in ([(0.0, 0.0), (bad, 0.0)], [(0.0, 0.0), (0.0, bad)], [(bad, 0.0)]):
        assert fed(samples) == (len(samples) - 1, Fault.SAMPLE_NOT_FINITE)


def test_x_that_jumps_is_found_and_neither_full_speed_nor_lost_samples_nor_a_restart_are_jumps():
    assert fed([(0.0, 0.0), (0.002, 0.0)]) == (1, Fault.X_JUMP)
    assert fed([(0.9 * 2.0 * T * 1e-9 * k, COUNT * k) for k in range(100)]) is None
    found = watch()
    assert feed(found, 0, 0.0, 0.0) is None and feed(found, 100, 0.05, 0.0) is None
    assert feed(found, 101, 0.06, 0.0) == (Fault.X_JUMP, "x went from 50.0000 to 60.0000 mm within one sample")
    found.restart()
    assert feed(found, 102, 1.0, 0.0) is None
    assert feed(found, 103, -1.0, 0.0)[0] is Fault.X_JUMP  # to the other side of zero
    # At the largest speed, exactly.
    found = watch(from_mapping(StageParameters, {"motion.highest_speed": 1.0}))
    step = T * 1e-9
    assert feed(found, 0, 0.0, 0.0) is None and feed(found, 2, 2.0 * step, 0.0) is None
    assert feed(found, 4, 4.001 * step, 0.0)[0] == Fault.X_JUMP
    # A count of x is more than this stage moves between two samples.
    found = watch(from_mapping(StageParameters, {"motion.highest_speed": 1e-3, "motion.speed": 5e-4, **COARSE}))
    assert feed(found, 0, 0.0, 0.0) is None and feed(found, 1, 1e-6, 0.0) is None
    assert feed(found, 2, 5e-6, 0.0)[0] == Fault.X_JUMP


def test_y_that_leaves_its_limit_is_found_and_y_that_comes_back_is_not():
    found = watch()
    assert feed(found, 0, 0.0, 1.2e-3) is None
    found.hold()
    assert feed(found, 1, 0.0, 1.1e-3) is None and feed(found, 2, 0.0, 1e-3) is None
    found.hold()
    assert feed(found, 3, 0.0, -1e-3) is None
    for y in (1e-3 + COUNT, -1e-3 - COUNT):
        fault, words = feed(found, 4, 0.0, y)
        assert fault is Fault.Y_OUT_OF_RANGE and f"y = {y * 1e6:.1f} µm; allowed: ±1000 µm" in words
    found.switched(on=True)
    assert feed(found, 5, 0.0, -1.1e-3) is None


def test_a_movement_beyond_the_travel_since_the_switch_on_is_a_fault_of_its_sample():
    found = watch()
    found.travel = 3e-6
    found.switched(on=True)
    assert not any(feed(found, step, 0.0, y) for step, y in enumerate((5e-6, 7e-6, 2.5e-6)))
    fault, words = feed(found, 3, 0.0, 8.2e-6)
    assert fault is Fault.FOLLOWING_ERROR and "moved by 3.2 µm" in words
    found.switched(on=True)
    assert feed(found, 4, 0.0, 8.2e-6) is None
    # A change holds from the next switch-on.
    found.travel = 1e-6
    assert feed(found, 5, 0.0, 10.2e-6) is None
    found.switched(on=True)
    assert feed(found, 6, 0.0, 10.2e-6) is None and feed(found, 7, 0.0, 12.2e-6)
    # A platform that is moved by hand, before the first switch-on and after a switch-off.
    found.switched(on=False)
    assert not any(
        feed(each, step, 0.0, y) for each in (found, watch(travel=3e-6)) for step, y in enumerate((0.0, 2e-3))
    )


def test_y_is_frozen_if_it_stays_although_the_current_has_moved_and_not_at_rest_or_by_a_law_that_switches():
    found = watch()
    findings = [feed(found, k, 0.0, 5e-6, -0.5 if k else 0.0) for k in range(2000)]
    assert findings[-1] == (Fault.Y_FROZEN, "y stays at 5.0 µm though the current changed by -0.50 A")
    still = [(0.0, 5 * COUNT)] * 5000
    assert fed(still, [0.05] * 5000) is None
    assert fed(still, [0.3 * (-1) ** k for k in range(5000)]) is None
    random.seed(1)
    moving = [(0.0, COUNT * round(10 * math.sin(0.01 * k) + random.random())) for k in range(5000)]
    assert fed(moving, [0.8 * math.sin(0.003 * k) for k in range(5000)]) is None
    # Nor is it with the amplifier off.
    found = watch()
    assert not any(feed(found, k, 0.0, COUNT * k, 0.5) for k in range(1000))
    found.switched(on=False)
    assert not any(feed(found, k, 0.0, COUNT * 1000) for k in range(1000, 3000))


@pytest.mark.parametrize(
    ("frozen_time", "frozen_current", "first", "currents"),
    [
        # The first sample changes y; twenty more of half a millisecond are ten milliseconds.
        (0.01, 0.08, (20,), [100.0] * 30),
        # However long it stood before: the time is that under the larger current.
        (0.01, 0.08, (119,), [0.0] * 100 + [1.0] * 30),
        # The mean of a step of 1 A takes 5 ms to 1 − 1/e: with that threshold the fault comes a sample after.
        (1e-9, 1.0 - math.exp(-1.0), (11, 12), [0.0] + [1.0] * 29),
    ],
    ids=["frozen_time", "from rest", "mean"],
)
def test_y_is_frozen_after_the_frozen_time_at_the_mean_current(frozen_time, frozen_current, first, currents):
    found = watch(frozen_time=frozen_time, frozen_current=frozen_current)
    findings = [bool(feed(found, k, 0.0, COUNT, current)) for k, current in enumerate(currents)]
    assert findings.index(True) in first and all(findings[findings.index(True) :])


def test_no_friction_within_the_uncertainty_makes_y_frozen_and_more_does():
    uncertain = {"uncertainty.friction": 3.0, "uncertainty.force": 0.4, "uncertainty.air_gap": 0.4}
    rough = from_mapping(StageParameters, uncertain)
    # The worst machine: K̄_i × 0.6 / 1.4², F_S × 3. Friction goes from −F_S to F_S before the platform moves.
    held = 2.0 * rough.friction.static * 3.0 / (rough.actuator.current_stiffness * 0.6 / 1.4**2)
    for change, frozen in ((held, False), (1.25 * held, True)):
        found = watch(rough)
        assert any([feed(found, k, 0.0, COUNT, change if k else 0.0) for k in range(400)]) == frozen
    # With a smaller uncertainty a dead encoder is found sooner.
    assert moving_current(STAGE, 0.01) == pytest.approx(0.108, abs=0.001)
    assert moving_current(rough, 0.01) > 0.3


def test_the_current_that_must_move_y_is_that_of_the_worst_machine_within_the_uncertainty():
    def current(time=0.004, **facts):
        known = {
            "uncertainty_mass": 0.0,
            "uncertainty_friction": 1.0,
            "uncertainty_force": 0.0,
            "uncertainty_air_gap": 0.0,
        }
        values = {name.replace("_", ".", 1): value for name, value in (known | facts).items()}
        return moving_current(from_mapping(StageParameters, values), time)

    mass, static, nominal = STAGE.platform.mass, STAGE.friction.static, current()
    assert current(uncertainty_friction=2.5) == pytest.approx(current(friction_static=2.5 * static))
    both = current(uncertainty_force=0.2, uncertainty_air_gap=0.1)
    assert both == pytest.approx(nominal * 1.1**2 / 0.8)
    # What a count takes in a shorter time, thrown up and falling again: 8 h / time² of the mass.
    turned = 2.0 * mass * 8.0 * COUNT / STAGE.actuator.current_stiffness / 0.004**2
    assert current(0.002) - nominal == pytest.approx(3.0 * turned)
    assert current(uncertainty_mass=0.3) - nominal == pytest.approx(0.3 * turned)


FREE = {"friction.coulomb": 0.0, "friction.static": 0.0}
HEAVY = {"platform.mass": 150.0, "encoder.y_resolution": 1e-6}


@pytest.mark.parametrize("facts", [FREE, {**FREE, **HEAVY}], ids=["light", "heavy"])
@pytest.mark.parametrize("rate", [100, 2000, 10_000])
@pytest.mark.parametrize("change", [0.01, 0.1, 1.0])
def test_a_platform_that_a_current_moves_from_rest_is_not_frozen_however_long_it_stood(facts, rate, change):
    stage = from_mapping(StageParameters, {**facts, "rate": rate})
    found, count = watch(stage), stage.encoder.y_resolution
    acceleration = change * stage.actuator.current_stiffness / stage.platform.mass
    for k in range(rate):
        # It stands for half a second. A command acts a sample late.
        moved = 0.5 * acceleration * (max(0, k - rate // 2 - 1) / rate) ** 2
        sample = Sample(k * stage.period_ns, 0.0, min(0.9e-3, math.floor(moved / count) * count), 0.0)
        if sample.y == 0.9e-3:
            break
        assert found.check(sample, change if k > rate // 2 else 0.0) is None


@pytest.mark.parametrize(
    ("mass", "count", "frozen_time"), [(3.0, 1e-7, 0.01), (40.0, 1e-6, 0.005), (150.0, 1e-6, 0.01), (1e4, 1e-6, 0.01)]
)
def test_half_of_the_largest_current_finds_a_dead_encoder_of_any_platform_in_time(mass, count, frozen_time):
    stage = from_mapping(StageParameters, {"platform.mass": mass, "encoder.y_resolution": count})
    found = watch(stage, frozen_time=frozen_time)
    change = 0.55 * stage.highest_current
    findings = [feed(found, k, 0.0, 0.0, change if k else 0.0) for k in range(stage.rate // 2)]
    assert findings[-1][0] is Fault.Y_FROZEN


def first_fault(facts, frozen_at=-1):
    """What the watch finds in two strokes of the simulated machine; from sample ``frozen_at`` on y stays."""
    values = shipped_parameters()
    values["stage"] |= {**facts, "motion.stroke": 0.05, "motion.settle": 0.5}
    found, machines, applied, faults = watch(node_parameters("driver", values).stage), [], [0.0], []

    def wired(machine):
        machines.append(FaultyHardware(machine))
        return machines[0]

    def observe(sample, truth, reference, command, age):
        if len(applied) == frozen_at:
            machines[0].inject("encoder y frozen")
        faults.append(found.check(sample, applied[-1]))
        applied.append(command.current)

    Simulation(values, wiring=wired).run(observe=observe)
    return next((finding[0] for finding in faults if finding), None)


@pytest.mark.parametrize(
    "facts",
    [
        FREE,
        {**FREE, "platform.stiffness": 1e5},
        {**FREE, "platform.stiffness": STAGE.actuator.position_stiffness, "encoder.y_resolution": 1e-6},
        {"friction.coulomb": 0.03, "friction.static": 0.04, "encoder.y_resolution": 1e-6},
        {**FREE, **HEAVY},
    ],
    ids=["no friction", "flexure", "balanced", "coarse", "heavy"],
)
def test_a_platform_with_hardly_any_friction_is_not_frozen_within_a_count_and_a_dead_encoder_is_found(facts):
    assert first_fault(facts) is None
    assert first_fault(facts, frozen_at=1500) is Fault.Y_FROZEN


def follow(positions, start_ns=0):
    """The stage's watch and motion, and the findings by the time in ns since the trajectory began."""
    stage, motion = StageWatch(WatchParameters()), PacedMotion(MotionParameters())
    motion.begin(TRAJECTORY, start_ns)
    findings = {at_ns: stage.check(start_ns + at_ns, x, motion) for at_ns, x in positions.items()}
    return stage, motion, {at_ns: finding for at_ns, finding in findings.items() if finding}


TIMES = range(0, TRAJECTORY.end_ns + SECOND, 50_000_000)


@pytest.mark.parametrize("start_ns", [0, 10**18])
def test_x_that_stays_while_the_stage_is_to_move_is_frozen_once(start_ns):
    assert StageWatch(WatchParameters()).check(start_ns, 0.0, PacedMotion(MotionParameters())) is None
    assert not follow({at_ns: TRAJECTORY.position(at_ns) for at_ns in TIMES}, start_ns)[2]
    stuck = TRAJECTORY.position(2 * SECOND)
    *_, found = follow(
        {at_ns: min(TRAJECTORY.position(at_ns), stuck) for at_ns in TIMES if at_ns < 4 * SECOND}, start_ns
    )
    ((at_ns, (fault, words)),) = found.items()
    moved = (TRAJECTORY.position(at_ns) - stuck) * 1e3
    assert 2 * SECOND < at_ns < 2_300_000_000 and fault is Fault.X_FROZEN
    assert f"{stuck * 1e3:.4f} mm" in words and f"{moved:+.1f} mm" in words


def test_a_stage_that_has_not_begun_to_move_along_this_trajectory_is_not_frozen():
    stage, motion, found = follow(dict.fromkeys(TIMES, 0.0))
    assert not found
    end_ns = TIMES[-1] + SECOND
    assert stage.check(end_ns, 0.025, motion) is None
    motion.begin(TRAJECTORY, end_ns)
    assert all(stage.check(end_ns + at_ns, 0.025, motion) is None for at_ns in (0, 3 * SECOND))


def test_a_stage_that_is_held_may_stand_still():
    for held in (True, False):
        watch, motion = StageWatch(WatchParameters()), PacedMotion(MotionParameters())
        motion.begin(TRAJECTORY, 0)
        where = [motion.position(at_ns) for at_ns in TIMES if at_ns <= 3 * SECOND]
        assert not any(watch.check(at_ns, x, motion) for at_ns, x in zip(TIMES, where, strict=False))
        motion.ask(Pace(hold=held))
        stands = motion.position(5 * SECOND) if held else where[-1]
        found = [watch.check(at_ns, stands, motion) for at_ns in range(5 * SECOND, 8 * SECOND, 50_000_000)]
        assert any(found) is not held


class Clocks:
    """Both clocks at hand; each reading of the monotonic one takes ``reading_ns``."""

    def __init__(self, reading_ns=1000):
        self.monotonic, self.offset, self.reading_ns = SECOND, 5_000 * SECOND, reading_ns
        self.watch = ClockWatch(WatchParameters(clock_step=0.05), self.monotonic_ns, self.system_ns)
        self.watch.restart()

    def monotonic_ns(self):
        self.monotonic += self.reading_ns
        return self.monotonic

    def system_ns(self):
        return self.monotonic + self.offset

    def check(self, late_ns=0):
        return self.watch.check(self.monotonic_ns() - late_ns, self.system_ns())


@pytest.mark.parametrize(
    ("step_ns", "found"),
    [(sign * step_ns, step_ns > 50_000_000) for sign in (1, -1) for step_ns in (50_000_000, 50_000_001, 3600 * SECOND)],
)
def test_a_step_of_the_systems_clock_beyond_the_limit_is_found_once(step_ns, found):
    clocks = Clocks(reading_ns=0)
    assert clocks.check() is None
    clocks.offset += step_ns
    finding = clocks.check()
    assert bool(finding) is found
    assert not found or (finding[0] is Fault.CLOCK_JUMP and f"{step_ns * 1e-9:+.3f} s" in finding[1])
    # Nor does it matter that the process was held up between the readings before.
    assert clocks.check(late_ns=SECOND) is None


def test_a_slewed_clock_is_followed_by_less_than_half_a_step_at_once():
    clocks = Clocks()
    for _ in range(100):
        clocks.offset += 10_000_000
        assert clocks.check() is None
        clocks.watch.follow()
    for slewed_ms, stepped_ms, found in ((30, 30, True), (24, 40, False)):
        clocks = Clocks(reading_ns=0)
        clocks.offset += slewed_ms * 1_000_000
        clocks.watch.follow()
        clocks.offset += stepped_ms * 1_000_000
        assert bool(clocks.check()) is found


def test_a_process_that_stood_still_between_two_readings_has_seen_no_step():
    clocks = Clocks()
    before = clocks.monotonic_ns()
    clocks.monotonic += 200_000_000
    assert clocks.watch.check(before, clocks.system_ns()) is None
    clocks.offset += SECOND
    clocks.reading_ns = 200_000_000
    assert clocks.check() is None
    clocks.reading_ns = 1000
    assert clocks.check() is not None


def test_a_step_is_judged_by_the_middle_of_the_readings_around_it():
    clocks = Clocks(reading_ns=0)
    clocks.offset += 65_000_000
    # The system's clock is read as the first of two readings ends, which are 20 ms apart.
    clocks.reading_ns = 20_000_000
    fault, words = clocks.check()
    assert fault is Fault.CLOCK_JUMP and "+0.055 s" in words


def test_a_following_error_is_a_fault_once_after_it_was_within_its_limit_with_the_amplifier_on():
    following = ErrorWatch(1e-5)
    samples = [(1e-3, True, False), (1e-6, True, False), (-2e-5, True, True), (-2e-5, True, False)]
    samples += [(0.0, True, False), (1.0, False, False), (1.0, True, False), (0.0, True, False), (math.nan, True, True)]
    findings = [following.check(error, amplifier_on=on) for error, on, _ in samples]
    assert [bool(finding) for finding in findings] == [found for _, _, found in samples]
    assert findings[2][0] is Fault.FOLLOWING_ERROR and "-20.0 µm" in findings[2][1]


@pytest.mark.parametrize("shift", [0.0, 5e-6, -0.3])
@pytest.mark.parametrize("event", ["", "lost samples", "lost counts"])
def test_a_zero_that_has_moved_is_found_where_the_encoder_has_counted_on_and_believed_after_a_loss(shift, event):
    def homed(watch, begin, zero, before):
        for k in range(begin, begin + 40):
            x = 0.05 * k * T * 1e-9 - (zero if k >= begin + 30 else before)
            x += 0.1 if event == "lost counts" and begin + 15 <= k < begin + 30 else 0.0
            late = 200 if event == "lost samples" and k >= begin + 15 else 0
            watch.look([Sample((k + late) * T, round(x / COUNT) * COUNT, 0.0, 0.0)], not begin + 1 <= k < begin + 30)
        return watch.finding

    found = ZeroWatch(STAGE)
    assert homed(found, 0, 0.2, 0.2) == ""
    finding = homed(found, 300, 0.2 + shift, 0.2)
    assert (f"moved by {-shift * 1e3:+.4f} mm" in finding) == bool(shift and not event)
    if not event:
        # Where the first one is found again all is well.
        assert homed(found, 600, 0.2, 0.2 + shift) == ""


@pytest.mark.parametrize("before", [0, 1, 3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("share", "counted"), [(0.0, True), (0.98, True), (1.02, False)])
def test_readings_that_noise_and_acceleration_explain_are_counted_on_and_no_others(before, sign, share, counted):
    found, step, motion = ZeroWatch(STAGE), T * 1e-9, STAGE.motion
    # Without a motion before, any speed is possible; with one, that of the last two readings changes.
    speed = 0.4 if before else 0.0
    changed = 2.0 * StageLimits.of(motion, 0.0, 0.0).acceleration * step**2 if before else motion.highest_speed * step
    for k in range(before + 1):
        found.look([Sample(k * T, speed * k * step, 0.0, 0.0)], True)
    x = speed * (before + 1) * step + sign * share * (changed + 2.0 * STAGE.encoder.x_noise)
    found.look([Sample((before + 1) * T, x, 0.0, 0.0)], False)
    assert found.finding == ""
    # Where the encoder has counted on, a reference that puts the zero elsewhere is wrong.
    found.look([Sample((before + 2) * T, x + 5.0, 0.0, 0.0)], True)
    assert bool(found.finding) is counted
