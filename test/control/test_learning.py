"""Learning from stroke to stroke: the table over x, its file, and strokes of machines that the law does not know."""

import math
import re
import shutil

import numpy as np
import pytest
from scipy.interpolate import BSpline

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control import learning as learning_module
from straightcomp_ros.control.excitation import Injection
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.learning import (
    BARE_SQUARE,
    BEST,
    BEST_SQUARE,
    COEFFICIENT,
    LearnedTable,
    Learning,
    LearningParameters,
    read_tables,
    write_tables,
)
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.sweep.trial import draw, streams

SPACING = 1e-3
MARGIN = 0.05


def table():
    return LearnedTable(SPACING, MARGIN)


def restored(coefficients):
    """A table that was learned at 0.2 m/s, whose first node is number -3."""
    found, count = table(), len(coefficients)
    found.restore(-3, coefficients, np.full(count, 1e-14), np.full(count, 4e-14), np.full(count, 0.2))
    return found


def one_pass(found, error, wanted=0.0, x=None, speed=0.2, asked=None):
    """A pass over 0 to 50 mm, ten samples a node, with a constant error; what is wanted is constant, too."""
    x = np.linspace(0.0, 0.05, 501) if x is None else x

    def answer(part):
        if asked is not None:
            asked.append(part)
        return np.full(x.size, wanted)

    found.learn(x, np.full(x.size, error), np.ones(x.size), answer, np.full(x.size, speed), 1.0, 1e-6)


def inside(found, at=(0.01, 0.02, 0.03, 0.04)):
    return [found.at(x, 0.2)[1] for x in at]


def test_the_correction_is_the_uniform_cubic_spline_of_its_coefficients_and_nothing_outside():
    coefficients = np.random.default_rng(1).normal(0.0, 1e-6, 12)
    found, first = restored(coefficients), -3
    # Coefficient k belongs to the node (first + k), around which its B-spline is centred.
    spline = BSpline((first + np.arange(-2, 14)) * SPACING, coefficients, 3)
    for x in np.linspace((first + 1) * SPACING, (first + 10) * SPACING - 1e-9, 200):
        weight, *rates = found.at(x, 0.2)
        assert weight == 1.0
        for order, (value, grain) in enumerate(zip(rates, (1e-18, 1e-14, 1e-9), strict=True)):
            assert value == pytest.approx(spline(x, order), abs=grain)
    for x in (-0.1, -2.01 * SPACING, 7.01 * SPACING, 0.1):
        assert found.at(x, 0.2) == table().at(x, 0.2) == (1.0, 0.0, 0.0, 0.0)


def test_the_weight_falls_evenly_from_one_to_zero_with_the_distance_from_the_learned_speed():
    found = restored(np.full(12, 1e-6))
    for away, weight in ((0.0, 1.0), (0.1, 1.0), (0.15, 0.75), (0.2, 0.5), (0.25, 0.25), (0.3, 0.0), (0.9, 0.0)):
        for sign in (-1.0, 1.0):
            assert found.at(0.0, 0.2 * (1.0 + sign * away))[0] == pytest.approx(weight, abs=1e-12)


@pytest.mark.parametrize(
    "passes, best",
    [
        # Error and wanted correction of each pass in µm, then the table, its updates and its caution.
        ([(1.0, 0.4, 0.4, 1, 1.0), (0.5, -5.0, -1.0, 2, 1.0)], 0.5),
        ([(1.0, 0.4, 0.4, 1, 1.0), (1.04, 0.5, 0.5, 2, 1.0), (1.06, 0.6, 0.0, 2, 0.5)], 1.0),
        # The third pass ran with 0.6 and was the best; the fourth with 0.7 was worse.
        ([(1.0, 0.4, 0.4, 1, 1.0), (0.5, 0.6, 0.6, 2, 1.0), (0.2, 0.7, 0.7, 3, 1.0), (0.9, 0.1, 0.6, 3, 0.5)], 0.2),
        # Worse than without: back to the best pass, which had none. Twice, then better ones: the gain grows again.
        (
            [
                *[(1.0, 0.4, 0.4, 1, 1.0), (2.0, 0.9, 0.0, 1, 0.5), (1.0, 0.2, 0.2, 2, 0.5), (2.0, 0.9, 0.0, 2, 0.25)],
                *[(1.0, 0.2, 0.2, 3, 0.25), (0.5, 0.3, 0.3, 4, 0.5), (0.4, 0.3, 0.3, 5, 1.0), (0.3, 0.3, 0.3, 6, 1.0)],
            ],
            0.3,
        ),
        # The fifth had no untried update, and was still better than without any: it is the best from then on.
        (
            [
                *[(1.0, 0.4, 0.4, 1, 1.0), (0.5, 0.4, 0.4, 2, 1.0), (0.5, 0.4, 0.4, 3, 1.0), (0.8, 0.5, 0.4, 3, 0.5)],
                (0.8, 0.5, 0.5, 4, 0.5),
            ],
            0.8,
        ),
        # Worse than without any, and not by an update: the machine has changed, and all is forgotten.
        ([(1.0, 0.4, 0.4, 1, 1.0), (3.0, 0.9, 0.0, 1, 0.5), (3.0, 0.9, 0.0, 0, 1.0)], None),
    ],
)
def test_what_is_wanted_is_learned_unless_the_pass_was_worse_than_the_best(passes, best):
    found, asked, accepted = table(), [], []
    for error, wanted, expected, updates, caution in passes:
        before = found.updates
        one_pass(found, error * 1e-6, wanted=wanted * 1e-6, asked=asked)
        assert inside(found) == pytest.approx([expected * 1e-6] * 4, abs=1e-20)
        assert (found.updates, found.caution) == (updates, caution)
        accepted += [caution] * (updates > before)
        assert found.tried is (updates > before)
    # The gain of an update is as cautious as the passes before were bad.
    assert asked == accepted
    if best is None:
        assert found.nodes.size == 0
    else:
        assert np.nanmax(found.nodes[BEST_SQUARE]) == pytest.approx(best**2 * 1e-12)
        assert np.nanmax(found.nodes[BARE_SQUARE]) == pytest.approx(1e-12)


def test_a_short_pass_is_judged_by_what_it_went_over_and_at_another_speed_it_starts_anew():
    found, half = table(), np.linspace(0.0, 0.02, 201)
    for error in (1e-6, 0.9e-6):
        one_pass(found, error, wanted=0.4e-6)
    one_pass(found, 0.8e-6, wanted=0.6e-6)
    one_pass(found, 2e-6, wanted=0.9e-6, x=half)
    assert inside(found, (0.005, 0.01)) == pytest.approx([0.4e-6] * 2) and (found.caution, found.updates) == (0.5, 3)
    one_pass(found, 0.5e-6, wanted=0.3e-6, x=half)
    assert inside(found, (0.005, 0.01)) == pytest.approx([0.3e-6] * 2) and found.updates == 4
    one_pass(found, 2e-6, wanted=0.1e-6, x=half, speed=0.6)
    assert found.at(0.01, 0.6)[:2] == (1.0, pytest.approx(0.1e-6)) and found.at(0.01, 0.2)[0] == 0.0
    assert found.at(0.04, 0.2)[:2] == (1.0, pytest.approx(0.4e-6))


def test_a_pass_over_another_stretch_makes_the_table_longer_and_keeps_what_it_knows():
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6, x=np.linspace(0.03, 0.05, 201))
    one_pass(found, 1e-6, wanted=0.2e-6, x=np.linspace(-0.02, 0.0, 201))
    one_pass(found, 1e-6, wanted=0.1e-6, x=np.linspace(0.08, 0.1, 201))
    assert inside(found, (-0.01, 0.04, 0.09)) == pytest.approx([0.2e-6, 0.4e-6, 0.1e-6])
    assert found.at(0.015, 0.2)[1] == 0.0
    assert found.first * SPACING <= -0.02
    assert (found.first + found.nodes.shape[1] - 1) * SPACING >= 0.1


def test_only_samples_with_weight_count_and_nodes_between_them_are_interpolated():
    found, nothing, x = table(), table(), np.linspace(0.0, 0.05, 501)
    weight = np.where(np.isin(np.floor(x / SPACING + 0.5), (20, 21, 22)), 0.0, 1.0)
    asked = np.where(weight > 0.0, 1e-6 * x / 0.05, 99.0)
    found.learn(x, np.full(x.size, 1e-6), weight, lambda _: asked, 0.2 * weight, 1.0, 1.0)
    assert inside(found) == pytest.approx([1e-6 * at / 0.05 for at in (0.01, 0.02, 0.03, 0.04)], abs=2e-9)
    nothing.learn(x, np.full(x.size, 1e-6), 0.0 * x, lambda _: asked, 0.2 + 0.0 * x, 1.0, 1.0)
    assert nothing.updates == 0 and not nothing.tried


FILE_SPACING = 0.25e-3


def tables():
    return {forward: LearnedTable(FILE_SPACING, 0.05) for forward in (True, False)}


def learned():
    random = np.random.default_rng(2)
    filled = tables()
    for forward, first, count in ((True, -8, 60), (False, 4, 30)):
        squares = random.uniform(1e-16, 1e-14, count)
        squares[:4] = math.nan
        # As in every table, the correction fades out over the nodes at its ends.
        coefficients = np.pad(random.uniform(-1e-6, 1e-6, count - 8), 4)
        filled[forward].restore(first, coefficients, squares, 2.0 * squares, np.full(count, 0.2))
    return filled


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "learned.csv"
    write_tables(path, "smc", learned())
    return path


def test_a_file_gives_back_what_was_written_and_nothing_leaves_no_file(file, tmp_path):
    write_tables(tmp_path / "none.csv", "smc", tables())
    assert not (tmp_path / "none.csv").exists()
    again, expected = tables(), learned()
    read_tables(file, "smc", again)
    for forward in (True, False):
        for x in np.linspace(-3e-3, 0.02, 40).tolist():
            assert again[forward].at(x, 0.2) == pytest.approx(expected[forward].at(x, 0.2), rel=1e-4, abs=1e-11)
    expected_nodes = expected[True].nodes
    found = again[True].nodes[:, : expected_nodes.shape[1]]
    np.testing.assert_allclose(found[[BEST_SQUARE, BARE_SQUARE]], expected_nodes[[BEST_SQUARE, BARE_SQUARE]], rtol=1e-5)
    # Before its first node, and where nothing was learned.
    assert np.isnan(again[False].nodes[BEST_SQUARE, :12]).all()
    second = file.with_name("second.csv")
    write_tables(second, "smc", again)
    assert second.read_text() == file.read_text()
    # As far away as a stroke may be.
    far, again = tables(), tables()
    far[True].restore(round(200.0 / FILE_SPACING), *np.full((4, 9), 1e-16))
    write_tables(second, "smc", far)
    read_tables(second, "smc", again)
    assert again[True].first == far[True].first


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda text: text.replace("# law: smc", "# law: linear"), "learned with law 'linear'; allowed: '# law: smc'"),
        (lambda text: text.replace("# law: smc\n", ""), "law None"),
        (lambda text: text.replace("x_m,", "x,"), "header 'x,forward"),
        (lambda text: "\n".join(text.splitlines()[:4]), "no rows"),
        (lambda text: text.replace("\n-0.00175,", "\n-0.0017,"), "x_m -0.0017; allowed: -0.00175"),
        (lambda text: text.replace("\n-0.00175,", "\nnan,"), "line 6: 'nan,"),
        (lambda text: text.replace("\n-0.00175,", "\n-0.00175,1"), "forward_correction_m within ±0.001"),
        (lambda text: text.replace("\n-0.00175,", "\n-0.00175,,"), "line 6: '-0.00175,,"),
        (lambda text: text.replace("\n-0.00175,", "\n"), "line 6: "),
        (lambda text: re.sub("\n-0.00175,[^,]*", "\n-0.00175,", text), "line 6: '-0.00175,,"),
    ],
)
def test_a_damaged_file_is_refused_with_the_place_and_what_is_allowed(file, change, message):
    text = file.read_text()
    file.write_text(change(text))
    assert file.read_text() != text
    with pytest.raises(ParameterError, match=re.escape(message)):
        read_tables(file, "smc", tables())
    for no_text in (file, file.parent):
        file.write_bytes(b"\xff\xfe")
        with pytest.raises(ParameterError, match=str(no_text)):
            read_tables(no_text, "smc", tables())


def test_a_correction_from_a_file_is_within_the_limit_also_where_an_update_is_taken_back(file):
    bound = learning(file=str(file), spacing=FILE_SPACING, limit=3e-7)
    for forward, table in learned().items():
        for row in (COEFFICIENT, BEST):
            expected = np.clip(table.nodes[COEFFICIENT], -3e-7, 3e-7)
            found = bound.tables[forward].between(-8, 60)[row, table.first + 8 :][: expected.size]
            np.testing.assert_allclose(found, expected, rtol=1e-5)
        corrections = [bound.tables[forward].at(x, 0.2)[1] for x in np.linspace(-3e-3, 0.02, 200).tolist()]
        assert 2e-7 < np.abs(corrections).max() <= 3e-7


def test_a_file_that_cannot_be_written_is_refused_before_and_keeps_what_was_learned_after(file, tmp_path, verb):
    folder = tmp_path / "away"
    folder.mkdir()
    path = folder / "learned.csv"
    shutil.copy(file, path)
    learner = learning(file=str(path), spacing=FILE_SPACING)
    learner.check_file()
    written = path.read_text()
    shutil.rmtree(folder)
    words = re.escape(f"'learning.file': '{path}'")
    with pytest.raises(ParameterError, match=words):
        learner.check_file()
    with pytest.raises(OSError, match=words):
        learner.save()
    folder.mkdir()
    learner.save()
    assert path.read_text() == written
    learning().check_file()
    # Offline too.
    learn = ("--learn", "--set=controller.learning.file=/proc/x.csv", "--law", "linear")
    found = verb("simulate", *learn, *SHORT)
    assert found.code == 1 and "'learning.file': '/proc/x.csv'" in found.err


SHORT = [f"--set=stage.motion.{name}" for name in ("stroke=0.05", "settle=0.2", "pause=0.1")]


def test_the_command_runs_strokes_keeps_what_it_learned_and_goes_on_from_there(tmp_path, verb):
    path = tmp_path / "learned.csv"
    command = ["simulate", "--law", "linear", "--learned", path, "--json", *SHORT]
    first = verb(*command, "--strokes", "4").json
    assert [set(cycle) for cycle in first["cycles"]] == [{"true_pp_um", "true_rms_um", "verdict", "reason"}] * 4
    assert first["cycles"][-1]["true_rms_um"] == first["true_rms_um"] < 0.75 * first["cycles"][0]["true_rms_um"]
    second = verb(*command).json
    assert "cycles" not in second
    assert second["true_rms_um"] < 0.75 * first["cycles"][0]["true_rms_um"]
    # Runs of one cycle each learn as well.
    path.unlink()
    alone = [verb(*command).json["true_rms_um"] for _ in range(3)]
    assert alone[0] == first["cycles"][0]["true_rms_um"] and alone[2] < alone[1] < 0.9 * alone[0]
    refused = verb("simulate", "--law", "smc", "--learned", path, *SHORT)
    assert refused.code == 2 and "law 'linear'" in refused.err


STAGE = StageParameters()
RATE, PERIOD_NS = 2000, 500_000
STROKE = MotionParameters(stroke=0.06, settle=0.2, pause=0.1)


def ripple_of_direction(x, forward):
    """What the formula servos leave: another shape in each direction."""
    return 0.3e-6 * math.sin(math.pi * x / 0.01) if forward else 0.2e-6 * math.cos(math.pi * x / 0.015)


class Rig:
    """A stage that cycles, and a servo y = T r − d(x), T a gain and a first-order lag."""

    def __init__(self, learning, gain=1.0, lag=0.0):
        self.learning, self.gain, self.now_ns = learning, gain, 0
        self.smoothing = 1.0 - math.exp(-1.0 / (RATE * lag)) if lag else 1.0
        self.trajectory = Trajectory(forward_and_back(STROKE))

    def cycle(self, each=lambda index: None):
        """RMS error in m of both directions; ``each`` is called with the index of each sample."""
        squares = {True: [], False: []}
        followed, last_x = 0.0, self.trajectory.position(0)
        for index in range(self.trajectory.end_ns // PERIOD_NS):
            x = self.trajectory.position(index * PERIOD_NS)
            forward = x >= last_x if x != last_x else index < self.trajectory.end_ns // PERIOD_NS // 2
            each(index)
            y = followed - ripple_of_direction(x, forward)
            r_law, _, _ = self.learning.step(self.now_ns, round(x, 7), y, (0.0, 0.0, 0.0))
            followed += self.smoothing * (self.gain * r_law - followed)
            if abs(x - last_x) > 0.02 / RATE:
                squares[forward].append(y * y)
            self.now_ns, last_x = self.now_ns + PERIOD_NS, x
        return {forward: math.sqrt(np.mean(values)) for forward, values in squares.items()}


def learning(**changes):
    return Learning(LearningParameters(**{"learn": True, **changes}), "smc", RATE)


@pytest.mark.parametrize("gain, lag", [(1.0, 0.0), (0.7, 0.001), (1.3, 0.002)])
def test_what_repeats_in_each_direction_vanishes_within_ten_passes(gain, lag):
    # The cut-off is above all that repeats here.
    rig = Rig(learning(forgetting=0.0, cutoff=50.0), gain, lag)
    bare = rig.cycle()
    for _ in range(9):
        last = rig.cycle()
    assert bare[True] > 0.1e-6 and bare[False] > 0.1e-6
    assert last[True] < 0.1 * bare[True] and last[False] < 0.1 * bare[False]


def test_the_cut_off_lies_well_below_half_of_the_rate():
    assert Learning(LearningParameters(learn=True, cutoff=40.0), "smc", 100.0)
    with pytest.raises(ParameterError, match=r"'learning\.cutoff': 40\.1 Hz; allowed: <= 40 Hz at this rate"):
        Learning(LearningParameters(learn=True, cutoff=40.1), "smc", 100.0)


def test_the_rates_of_the_corrected_reference_are_its_derivatives_on_a_stage_that_accelerates():
    learner = learning()
    for table in learner.tables.values():
        coefficients = 0.5e-6 * np.sin(np.arange(1200) * 0.25e-3 / 0.004)
        table.restore(-100, coefficients, np.ones(1200), np.ones(1200), np.zeros(1200))
    corrected = []
    for index in range(2400):
        moving = max(0, index - 400) / RATE
        corrected.append(learner.step(index * PERIOD_NS, 0.5 * 0.2 * moving**2, 0.0, (0.0, 0.0, 0.0)))
    r, r_dot, r_ddot = np.array(corrected)[1600:].T
    # Beyond the speed at which it fades, and after the estimates of speed and acceleration have settled.
    for value, rate in ((r, r_dot), (r_dot, r_ddot)):
        expected = np.gradient(value, 1.0 / RATE)
        assert np.abs(rate - expected)[10:-10].max() < 0.005 * np.abs(expected).max()


@pytest.mark.parametrize(
    "motion, rate, fade_speed",
    [
        # More than a jump within a sample.
        ({"stroke": 4.0, "speed": 6.0, "highest_speed": 10.0, "acceleration": 20.0}, 500, 0.02),
        ({"stroke": 0.001, "speed": 0.0005}, 500, 0.0004),
    ],
)
def test_fast_and_slow_stages_are_learned_from(motion, rate, fade_speed):
    motion, learning = MotionParameters(settle=0.5, **motion), LearningParameters(learn=True, fade_speed=fade_speed)
    learner, trajectory = Learning(learning, "smc", rate), Trajectory(forward_and_back(motion))
    for at_ns in range(0, trajectory.end_ns, 10**9 // rate):
        learner.step(at_ns, trajectory.position(at_ns), 0.0, (1e-7, 0.0, 0.0))
    assert learner.counters() == {"learned_forward": 1, "learned_backward": 1}


def test_an_encoder_that_toggles_at_rest_corrects_no_reference_however_slow_the_stage_may_be():
    motion = MotionParameters(stroke=0.05, speed=0.1, settle=0.5)
    learner = Learning(LearningParameters(learn=True, fade_speed=1e-9), "smc", RATE)
    trajectory = Trajectory(forward_and_back(motion))
    positions = [trajectory.position(at_ns) for at_ns in range(0, trajectory.end_ns, PERIOD_NS)]
    toggles = np.random.default_rng(0).integers(0, 2, 4000) * 1e-7
    asked = [
        learner.step(index * PERIOD_NS, x, 0.0, (1e-7, 0.0, 0.0))
        for index, x in enumerate([*positions, *toggles.tolist()])
    ]
    assert learner.tables[True].updates == learner.tables[False].updates == 1
    assert set(asked[len(positions) + 200 :]) == {(1e-7, 0.0, 0.0)}


def test_nothing_is_learned_from_a_pass_with_a_test_signal_in_it():
    learner, trajectory = learning(), Trajectory(forward_and_back(STROKE))
    servo = Servo(make_law(ControlParameters(law="linear"), STAGE), learning=learner)
    for index in range(trajectory.end_ns // PERIOD_NS):
        if index == round(0.6 * RATE):
            servo.inject(Injection(np.zeros(20), fade=1, limit=1.0, travel=1.0))
        servo.step(index * PERIOD_NS, 0.0, 0.0, (1e-7, 0.0, 0.0), trajectory.position(index * PERIOD_NS))
    assert {forward: table.updates for forward, table in learner.tables.items()} == {True: 0, False: 1}


@pytest.mark.parametrize("x", [None, math.nan, 7.0])
def test_nothing_is_learned_from_a_pass_that_was_interrupted_or_in_which_x_jumps(x):
    learner = learning()

    def disturb(index):
        if index == round(0.6 * RATE):
            learner.interrupt() if x is None else learner.step(0, x, 0.0, (0.0, 0.0, 0.0))

    Rig(learner).cycle(disturb)
    assert learner.tables[True].updates == 0
    assert learner.tables[False].updates == 1


@pytest.mark.parametrize(("limit", "beyond"), [("_SHORTEST", 1), ("_LONGEST", -1)])
def test_nothing_is_learned_from_a_pass_that_is_too_short_or_never_ends(monkeypatch, limit, beyond):
    """A stage that creeps on for minutes must not fill the memory."""
    jobs = []
    Rig(Learning(LearningParameters(learn=True), "smc", RATE, jobs.append)).cycle()
    samples = len(jobs[0].args[1])
    for allowed, learned in ((samples, 1), (samples + beyond, 0)):
        monkeypatch.setattr(learning_module, limit, allowed)
        rig = Rig(learning())
        rig.cycle()
        assert rig.learning.tables[True].updates == learned


def test_what_is_done_at_the_end_of_a_pass_may_be_done_later():
    jobs = []
    later = Rig(Learning(LearningParameters(learn=True), "smc", RATE, jobs.append))
    at_once = Rig(learning())
    later.cycle()
    at_once.cycle()
    assert len(jobs) == 2 and later.learning.tables[True].updates == 0
    for job in jobs:
        job()
    assert later.cycle() == at_once.cycle()


def test_while_the_amplifier_is_off_nothing_is_corrected_and_nothing_learned():
    learner = learning()
    rig = Rig(learner)
    for _ in range(2):
        rig.cycle()
    updates = learner.tables[True].updates
    servo = Servo(make_law(ControlParameters(law="linear"), STAGE), learning=learner)
    ends = rig.trajectory.end_ns
    for at_ns in range(0, ends, PERIOD_NS):
        answer = servo.step(rig.now_ns + at_ns, 1e-6, math.nan, (0.0, 0.0, 0.0), rig.trajectory.position(at_ns))
        assert answer is not None and answer.current == 0.0
    assert learner.tables[True].updates == updates
    # Switched on in the middle of a stroke, the correction waits for the stage to stand still.
    for at_ns in range(600 * PERIOD_NS, 1000 * PERIOD_NS, PERIOD_NS):
        asked = (1.0, 2.0, 3.0)
        assert learner.step(rig.now_ns + ends + at_ns, rig.trajectory.position(at_ns), 0.0, asked) == asked


def test_the_error_that_is_reported_is_that_of_the_reference_asked_for():
    learner = learning()
    for table in learner.tables.values():
        table.restore(-100, np.full(1000, 0.5e-6), np.ones(1000), np.ones(1000), np.zeros(1000))
    law = ControlParameters(law="linear")
    servos = Servo(make_law(law, STAGE), learning=learner), Servo(make_law(law, STAGE))
    for index in range(600):
        x = max(0, index - 200) * 0.05 / RATE
        corrected, plain = (servo.step(index * PERIOD_NS, 0.0, 0.0, (1e-6, 0.0, 0.0), x) for servo in servos)
        assert corrected.error == plain.error == 1e-6
    assert corrected.current != plain.current


def cycles_of(values, learn):
    simulation = Simulation({**values, "controller": {**values["controller"], "learning.learn": learn}})
    return [evaluate(simulation.run(), simulation.map) for _ in range(12)]


@pytest.mark.nightly
@pytest.mark.parametrize(
    "law, seed, gained, chance", [("smc_observer", 4, 1.0, 1.1), ("smc", 3, 0.97, 1.04), ("linear", 5, 0.7, 1.04)]
)
def test_no_machine_within_the_uncertainty_is_worse_off_than_without_learning_but_by_chance(law, seed, gained, chance):
    """`smc_observer` leaves 22 nm RMS, less than the encoder's rounding: there is nothing to learn, and means of eleven
    cycles with and without learning differ by 4.7 % (standard deviation of 8 machines) around 0.97: `chance` is twice
    that above 1."""
    means, ratios = [], []
    for trial in range(4):
        machine = factors, _, delay = draw(StageParameters(), streams(seed, trial).machine)
        values = {
            "driver": {
                "simulated.truth.guide": "config/guide_synthetic.csv",
                **{f"simulated.truth.{name}": factor for name, factor in factors._asdict().items() if name != "modes"},
            },
            "controller": {"control.law": law},
            "stage": {"drive.delay": delay, "motion.stroke": 0.04, "motion.settle": 0.2, "motion.pause": 0.1},
        }
        learned, bare = ([cycle.true_rms for cycle in cycles_of(values, learn)] for learn in (True, False))
        # Two passes differ by chance by up to 10 %: it depends on the count at which the platform came to rest.
        assert max(learned) < 1.06 * max(bare), machine
        means.append(np.mean(learned[1:]) / np.mean(bare))
        assert means[-1] < chance, machine
        ratios.append(np.mean(learned[-2:]) / np.mean(bare))
    assert np.mean(means) < 1.0 and np.mean(ratios) < gained
