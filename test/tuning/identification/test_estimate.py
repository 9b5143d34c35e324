"""The truth lies in the intervals, and the intervals are as narrow as they should be, or said to be wide; the answer as
JSON and as a parameter file that simulate takes."""

import dataclasses
import itertools
import math
import re
import shlex
from types import SimpleNamespace

import numpy as np
import pytest
from recorded_run import recorded_run, rewired
from verbs import ran

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis import current_path as recording
from straightcomp_ros.analysis.current_path import CurrentPath, read_recording
from straightcomp_ros.cli.options import settings
from straightcomp_ros.contract import COMMAND, ENCODER, STROKE
from straightcomp_ros.model.actuator import ActuatorParameters
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.model.motion import MotionParameters, goals, reach
from straightcomp_ros.model.plant import advance, plant_state
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.node_parameters import STAGE, changed, node_parameters
from straightcomp_ros.parameters.parameter_file import read_parameter_file, shipped_parameters
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap
from straightcomp_ros.straightness.survey import read_survey, write_survey
from straightcomp_ros.tuning.identification import fit as fitting
from straightcomp_ros.tuning.identification.estimate import (
    DERIVED,
    UNITS,
    Estimate,
    Estimated,
    estimate_from_bag,
    excitation,
    least_travel,
    parameter_file,
)
from straightcomp_ros.tuning.identification.unknowns import NAMES, centre, sliding_start, unknowns
from straightcomp_ros.tuning.verbs import friction

START = StageParameters()
STRIBECK = START.friction.stribeck_velocity
SHORT = {"motion.stroke": 0.5, "motion.settle": 0.2, "motion.pause": 0.1}
STIFF = {
    "platform.mass": 3.4,
    "friction.coulomb": 0.3,
    "friction.static": 0.5,
    "friction.stribeck_velocity": 30e-6,
    "friction.bristle_stiffness": 1.5e6,
    "friction.viscous": 25.0,
}
SOFT = {
    "platform.mass": 4.2,
    "actuator.air_gap": 1.6e-3,
    "friction.coulomb": 0.9,
    "friction.static": 1.1,
    "friction.stribeck_velocity": 100e-6,
    "friction.bristle_stiffness": 4e5,
    "friction.bristle_damping": 600.0,
    "friction.viscous": 40.0,
}
FAR = {
    "platform.mass": 3.3,
    "actuator.turns": 361.0,
    "actuator.air_gap": 9.5e-4,
    "friction.coulomb": 0.15,
    "friction.static": 0.225,
    "friction.viscous": 3.5,
    "drive.bandwidth": 770.0,
    "drive.delay": 1.33,
}
"""So far from the description that a search from there ends in a wrong valley."""
SAFE = {"control.smc.natural_frequency": 14.0, "control.smc.phi": 13.8}
"""Gains of law 'linear' that are stable on FAR as on the description."""


def values(plant, law="linear", **stage):
    """Parameters for a short run on a machine with this plant, of which the law knows nothing."""
    return {
        "driver": {f"stage.{name}": value for name, value in plant.items()},
        "feedforward": {},
        "controller": {"control.law": law},
        "cell": {},
        "stage": {"drive.delay": 0.5, **SHORT, **{name.replace("_", "."): value for name, value in stage.items()}},
    }


@pytest.fixture(scope="module")
def waves(tmp_path_factory):
    """The map of an excitation of the whole stroke."""
    path = tmp_path_factory.mktemp("excitation") / "excitation.csv"
    write_survey(path, excitation(START).survey)
    return str(path)


@pytest.fixture(scope="module")
def stiff_bag(tmp_path_factory, waves):
    return recorded_run(tmp_path_factory.mktemp("stiff") / "bag", values(STIFF, guide_file=waves))


@pytest.fixture(scope="module")
def far_bag(tmp_path_factory, waves):
    """A machine that the description does not fit, under a law that is slow enough for both."""
    parameters = values({**FAR, "platform.stop": 8e-4}, guide_file=waves)
    parameters["controller"].update(SAFE)
    return recorded_run(tmp_path_factory.mktemp("far") / "bag", parameters)


@pytest.fixture(scope="module")
def stiff_answer(waves, tmp_path_factory):
    """What `straightcomp friction BAG -o FILE --json` says of the stiff plant after a short way, and the file."""
    folder = tmp_path_factory.mktemp("answer")
    bag, file = recorded_run(folder / "bag", values(STIFF, guide_file=waves, motion_stroke=0.2)), folder / "plant.yaml"
    found = ran("friction", bag, "-o", file, "--json")
    assert found.code == 0, found.err
    return found.json, file


WITHIN = {
    "platform.mass": 0.01,
    "actuator.air_gap": 0.002,
    "friction.coulomb": 0.005,
    "friction.static": 0.15,
    "friction.stribeck_velocity": 0.15,
    "friction.bristle_stiffness": 0.03,
    "friction.bristle_damping": 0.15,
    "friction.viscous": 0.03,
}
"""Relative errors that an excited plant stays below."""


def truth_of(plant):
    whole = {**to_mapping(START), **plant}
    magnets = ActuatorParameters(
        **{name.partition(".")[2]: whole[name] for name in whole if name.startswith("actuator.")}
    )
    return {**whole, **{name: getattr(magnets, name.removeprefix("actuator.")) for name in DERIVED}}


def is_within(found, truth):
    return found.low <= truth * (1 + 1e-9) and truth <= found.high * (1 + 1e-9)


def assert_found(parameters, plant):
    """All are within their intervals, and within the stated bounds."""
    truth = truth_of(plant)
    for name, found in parameters.items():
        assert is_within(found, truth[name]), name
        if name in WITHIN:
            assert found.value == pytest.approx(truth[name], rel=WITHIN[name]), name


FIGURES = (
    "samples samples_in_bag duration_s prediction_error_um prediction_error_ratio amplifier_bandwidth_Hz "
    "amplifier_bandwidth_deviation_Hz delay_us delay_spread_us centre_um parameters not_identifiable"
)
OF_A_PARAMETER = "value low high unit known poorly_determined hardly_told_apart_from"


def test_an_excited_plant_is_found_within_its_intervals_and_within_stated_bounds(stiff_answer):
    answer, _ = stiff_answer
    parameters = answer["parameters"]
    assert set(answer) == set(FIGURES.split()) and list(parameters) == list(UNITS)
    assert all(set(found) == set(OF_A_PARAMETER.split()) for found in parameters.values())
    assert_found({name: SimpleNamespace(**found) for name, found in parameters.items()}, STIFF)
    assert all(found["low"] <= found["value"] <= found["high"] for found in parameters.values())
    assert not any(found["poorly_determined"] for found in parameters.values())
    assert parameters["actuator.turns"]["known"]
    assert answer["amplifier_bandwidth_Hz"] == pytest.approx(500.0, rel=1e-3)
    assert answer["delay_us"] == pytest.approx(250.0, abs=5.0)
    # An encoder of 0.1 µm that is predicted as well as it reads.
    assert answer["prediction_error_um"] == pytest.approx(0.1 / 12**0.5, rel=0.2)


@pytest.mark.nightly
def test_another_plant_under_another_law_is_found_too(tmp_path, waves):
    bag = recorded_run(tmp_path / "bag", values(SOFT, law="smc", guide_file=waves))
    estimate = estimate_from_bag(bag, START, ["actuator.turns"])
    assert_found(estimate.parameters, SOFT)
    assert not any(found.poor for found in estimate.parameters.values())
    assert estimate.path.delay == pytest.approx(250e-6, abs=5e-6)
    assert "stage.platform.mass: 4." in parameter_file(estimate)


@pytest.mark.nightly
def test_a_coarse_encoder_leaves_the_forces_less_certain_than_a_fine_one(tmp_path, waves):
    widths, truth = {}, truth_of(STIFF)
    # STIFF has its own mass, and the description's is taken as known: what is compared is relative to it.
    scale = START.platform.mass / truth["platform.mass"]
    for count in (5e-8, 4e-7):
        parameters = values(STIFF, guide_file=waves)
        parameters["stage"]["encoder.y_resolution"] = count
        start = dataclasses.replace(START, encoder=dataclasses.replace(START.encoder, y_resolution=count))
        found = estimate_from_bag(recorded_run(tmp_path / f"{count}", parameters), start, ["platform.mass"]).parameters
        widths[count] = found["actuator.turns"].high / found["actuator.turns"].value - 1.0
        for name in ("friction.coulomb", "actuator.current_stiffness"):
            assert found[name].low <= truth[name] * scale <= found[name].high, name
    assert widths[4e-7] > 3.0 * widths[5e-8]


@pytest.mark.nightly
def test_a_stroke_along_the_guide_says_what_it_cannot_identify(tmp_path):
    estimate = estimate_from_bag(recorded_run(tmp_path / "bag", values(STIFF)), START, ["actuator.turns"])
    truth, parameters = truth_of(STIFF), estimate.parameters
    for name, found in parameters.items():
        # The interval of what this motion hardly identifies is itself no more than a guess: it must be said to be poor.
        assert is_within(found, truth[name]) or found.poor, name
    assert not parameters["actuator.air_gap"].poor
    assert all(parameters[name].poor for name in ("platform.mass", "friction.static", "friction.viscous"))


def test_sliding_alone_leads_near_the_machine_whatever_the_description_says_if_there_is_enough_of_it(far_bag):
    begin, recording = unknowns(START, ["platform.mass"]), read_recording(far_bag)
    slid = sliding_start(recording, begin)
    assert slid is not None
    ratio = START.platform.mass / FAR["platform.mass"]
    found, truth = dict(zip(NAMES, np.exp(slid).tolist(), strict=True)), truth_of(FAR)
    assert found["platform.mass"] == pytest.approx(START.platform.mass)
    assert found["actuator.air_gap"] == pytest.approx(truth["actuator.air_gap"], rel=0.01)
    assert found["actuator.turns"] ** 2 == pytest.approx(truth["actuator.turns"] ** 2 * ratio, rel=0.1)
    assert found["friction.coulomb"] == pytest.approx(truth["friction.coulomb"] * ratio, rel=0.1)
    assert found["friction.bristle_stiffness"] == pytest.approx(START.friction.bristle_stiffness)
    assert sliding_start(dataclasses.replace(recording, y=0.01 * recording.y), begin) is None


@pytest.mark.nightly
def test_a_machine_far_from_its_description_is_found_up_to_the_scale_of_forces(far_bag):
    estimate = estimate_from_bag(far_bag, dataclasses.replace(START, drive=DriveParameters()), ["platform.mass"])
    ratio = START.platform.mass / FAR["platform.mass"]
    truth, found = truth_of(FAR), estimate.parameters
    assert found["actuator.air_gap"].value == pytest.approx(truth["actuator.air_gap"], rel=0.005)
    for name in ("actuator.current_stiffness", "actuator.position_stiffness", "friction.coulomb"):
        assert found[name].value == pytest.approx(truth[name] * ratio, rel=0.01), name
    assert estimate.path.rate == pytest.approx(2.0 * math.pi * FAR["drive.bandwidth"], rel=1e-3)
    assert estimate.path.delay == pytest.approx(FAR["drive.delay"] / START.rate, rel=1e-3)
    assert "platform.mass was given" in estimate.not_identifiable[0]


def exact(**others):
    """An exact estimate, but for ``others`` of friction: low and high of 1.0, and what they are hardly told from."""
    parameters = {name: Estimated(name, 1.0, 0.99, 1.01, name == "platform.mass") for name in UNITS}
    for name, (low, high, *alike) in others.items():
        found = Estimated(f"friction.{name}", 1.0, low, high, False, tuple(f"friction.{one}" for one in alike))
        parameters[found.name] = found
    return Estimate(parameters, None, CurrentPath(1.0, None, None, None, 1e-4, False, 0.0, (1e-4, 1e-4)), None)


def test_what_the_record_leaves_open_is_said_in_sentences():
    sentences = exact(viscous=(0.5, 2.0, "static"), static=(0.9, 1.1, "viscous")).not_identifiable
    assert "platform.mass was given" in sentences[0] and "actuator.turns" not in sentences[0]
    assert "bandwidth" in sentences[1]
    assert sum("told apart" in sentence for sentence in sentences) == 1
    assert "friction.viscous is only known to lie between 0.5 and 2 N·s/m." in sentences
    assert len(sentences) == 4


@pytest.mark.parametrize("coulomb", [(0.99, 1.01), (0.1, 10.0)])
def test_what_is_poorly_determined_is_left_out_of_the_file_and_marked(coulomb):
    lines = parameter_file(exact(viscous=(0.1, 10.0), static=(0.1, 10.0), coulomb=coulomb)).splitlines()
    assert "    # stage.friction.viscous: 1.0" in lines
    assert "    # 0.1 to 10 N·s/m, poorly determined" in lines
    assert "    stage.friction.bristle_damping: 1.0" in lines
    # F_S stays with F_C even so: its default may be below F_C, which is refused.
    assert ("    stage.friction.static: 1.0" in lines) is (coulomb == (0.99, 1.01))


SHIFT = 25e-6
"""m; of the zero of an encoder of y off the magnets' centre."""


def test_a_centre_of_the_magnets_off_the_encoders_zero_is_found(stiff_bag):
    recorded = read_recording(stiff_bag)
    aligned, off = (centre(dataclasses.replace(recorded, y=recorded.y + by), STRIBECK) for by in (0.0, SHIFT))
    assert aligned is not None and not aligned.certain and abs(aligned.value) < 0.1e-6
    assert off is not None and off.certain and off.value == pytest.approx(SHIFT, abs=0.1e-6)


@pytest.mark.parametrize(("stiffness", "shift"), [(1e4, -1e-5), (-1e4, 1e-5), (0.0, None)])
@pytest.mark.parametrize(
    ("period_ns", "samples", "share", "within"),
    [
        (500_000, 8000, 1.0, 0.01),
        (2_000_000, 1500, 1.0, 0.02),
        (500_000, 16000, 0.05, 0.01),
        (500_000, 2000, 1.0, None),
    ],
    ids=["usual", "500 Hz", "up to 0.15 mm/s", "too short for an interval"],
)
def test_a_platform_has_a_centre_on_a_flexure_that_is_stiffer_than_the_magnets_but_none_on_one_as_stiff(
    stiffness, shift, period_ns, samples, share, within
):
    # From the equation of motion, with a constant force of 0.1 N/kg.
    time, ways = 1e-9 * period_ns * np.arange(samples), ((5e-5, 30.0), (2e-5, 70.0))
    y, speed, acceleration = (
        share * sum(amplitude * rate**order * np.cos(rate * time + order * math.pi / 2.0) for amplitude, rate in ways)
        for order in range(3)
    )
    current = (acceleration - stiffness * y + 3.0 * speed - 0.1) / 14.0
    current += 1e-3 * share * np.random.default_rng(1).standard_normal(time.size)
    found = centre(recording.Recording(period_ns, y, y, current, current, time.size), STRIBECK)
    assert (found and found.value) == (shift and within and pytest.approx(shift, rel=within))


@pytest.mark.nightly
def test_a_centre_of_the_magnets_off_the_encoders_zero_harms_no_other_fact(tmp_path, waves):
    shifted = rewired(lambda sample: sample._replace(y=sample.y + SHIFT))
    bag = recorded_run(tmp_path / "bag", values(STIFF, guide_file=waves), wiring=shifted)
    found = estimate_from_bag(bag, START, ["actuator.turns"])
    for name in ("platform.mass", "actuator.air_gap", "friction.coulomb"):
        assert found.parameters[name].value == pytest.approx(truth_of(STIFF)[name], rel=WITHIN[name]), name


def test_the_file_describes_the_plant_to_all_nodes_and_simulate_takes_it(stiff_answer, verb):
    answer, file = stiff_answer
    values = read_parameter_file(file)
    assert {key for key, section in values.items() if section} == {STAGE}
    for node in ("driver", "controller"):
        described = to_mapping(node_parameters(node, values).stage)
        for name, found in answer["parameters"].items():
            if name not in DERIVED:
                assert described[name] == pytest.approx(found["value"], rel=1e-5), name
    short = [f"--set=stage.motion.{name}" for name in ("stroke=0.05", "settle=0.1", "pause=0.1")]
    for option in ("--stage", "--params-file"):
        found = verb("simulate", option, file, "--law", "linear", "--json", *short)
        assert found.code == 0 and found.json["law"] == "linear"


def test_the_truth_is_never_read(stiff_bag, monkeypatch):
    asked = []
    read = recording.read_streams
    monkeypatch.setattr(recording, "read_streams", lambda bag, layouts: asked.extend(layouts) or read(bag, layouts))
    recording.read_recording(stiff_bag)
    assert asked == [ENCODER.topic, COMMAND.topic]


@pytest.mark.parametrize(
    ("start", "stroke", "travel", "other"),
    [
        (0.4, -0.3, 1e-4, ""),
        (0.2, 0.3, 4e-5, ", stage.guide.min_points: 1000, stage.guide.max_gap: 0.0001"),
        (0.4, -0.3, 1e-4, ", stage.motion.steps: 10"),
        (0.1, 0.3, 1e-4, ", stage.motion.file: {}"),
    ],
)
def test_the_command_after_an_excitation_is_of_the_users_stage_with_that_guide_and_stays_on_the_map(
    tmp_path, verb, start, stroke, travel, other
):
    """In one stroke each way: stops would make its waves slow. Nor is it held to what is demanded of the survey."""
    (tmp_path / "positions.txt").write_text("0.2\n0.4\n0.3\n")
    own, waves = tmp_path / "my stage.yaml", tmp_path / "waves.csv"
    own.write_text(
        f"/**: {{ros__parameters: {{stage.name: mine, stage.motion: {{start: {start}, stroke: {stroke}}}, "
        f"stage.guide.travel: {travel}{other.format(tmp_path / 'positions.txt')}}}}}"
    )
    chosen = ["--stage", str(own), "--law", "smc", "--set", "stage.motion.pause=0.2"]
    code, _, said = verb("friction", "--excitation", waves, *chosen)
    x = read_survey(waves).runs[0].x
    assert code == 0
    assert (x[0], x[-1]) == pytest.approx((min(start, start + stroke), max(start, start + stroke)))
    (then,) = re.findall("next: straightcomp (.*) --bag BAG, or", " ".join(said.split()))
    words = shlex.split(then)
    assert {*chosen, f"driver.simulated.truth.guide={waves}"} < set(words)
    given = settings([word for option, word in itertools.pairwise(words) if option == "--set"])
    motion = node_parameters("driver", changed(shipped_parameters(stage=str(own)), given)).stage.motion
    assert len(goals(motion)) == 2 and reach(motion) == pytest.approx((x[0], x[-1]))
    # The safest law follows the waves badly; what counts is that it stays on the map.
    assert verb(*words, "--json").json["verdict"] in ("in_order", "inaccurate")


@pytest.mark.parametrize(
    ("length", "speed", "acceleration"), [(STROKE, 0.3, 0.2), (0.45, 0.3, 2.0), (0.05, 0.3, 2.0), (0.05, 0.05, 0.5)]
)
def test_an_excitation_stays_within_the_platforms_travel_where_it_runs_out_too_and_is_the_usual_one_where_it_does(
    length, speed, acceleration
):
    stage = StageParameters(motion=MotionParameters(speed=speed, acceleration=acceleration, stroke=length))
    usual = excitation(dataclasses.replace(stage, guide=MapParameters(travel=1e-2))).survey
    for travel in (2e-5, 4e-5, 1e-4, 3e-4):
        guide = MapParameters(travel=travel)
        survey, facts = excitation(dataclasses.replace(stage, guide=guide))
        # It is refused where it reaches farther.
        made = StraightnessMap(survey, dataclasses.replace(guide, runout=facts["guide.runout"]))
        whole = made.largest < 0.89 * travel
        assert np.array_equal(survey.runs[0].deviation, usual.runs[0].deviation) == whole
        assert whole or made.largest == pytest.approx(0.9 * travel)


PARAMS, OWN = (str(share_path(f"config/{name}")) for name in ("straightcomp.yaml", "stage_synthetic.yaml"))


@pytest.mark.parametrize(
    ("options", "attached", "mass"),
    [
        ((), True, STIFF["platform.mass"]),
        (("--set", "stage.platform.mass=3.6"), True, 3.6),
        (("--stage", OWN), True, 3.0),
        (("--params-file", PARAMS, "--set", "stage.platform.mass=3.5"), True, 3.5),
        ((), False, 3.0),
    ],
)
def test_an_estimate_starts_from_the_stage_of_the_recorded_run_unless_another_is_named(
    stiff_bag, verb, monkeypatch, options, attached, mass
):
    starts = []
    monkeypatch.setattr(friction, "estimate_from_bag", lambda bag, start, *_: starts.append(start))
    monkeypatch.setattr(friction, "_print", lambda estimate: None)
    if not attached:
        monkeypatch.setattr(friction, "read_attachments", lambda bag: {})
    else:
        # Of a board whose DBC file is on the machine.
        driver = friction.recorded_parameters(stiff_bag, friction.read_attachments(stiff_bag))["driver"]
        of_a_board = {"driver": {**driver, "hardware": "can", "can.dbc": "nowhere.dbc"}}
        monkeypatch.setattr(friction, "recorded_parameters", lambda *_: of_a_board)
    ended = verb("friction", stiff_bag, *options)
    assert ended.code == 0 and [start.platform.mass for start in starts] == [mass]
    # Which stage it is is said where neither the user nor the bag says it.
    assert ("config/stage_synthetic.yaml is assumed" in ended.err) == (not attached)


def test_a_bag_whose_recorded_stage_is_refused_is_named(stiff_bag, verb):
    code, _, said = verb("friction", stiff_bag, "--set", "stage.platform.mass=-1")
    assert code == 2 and f"bag {stiff_bag}: " in said and "mass" in said


DESCRIBED, SLID = 0.0, 1.0


NONE, THIRD, LAST = fitting.MISSED[1:], fitting.MISSED[2:3], fitting.MISSED[3:]
"""Assumptions that fail."""


@pytest.mark.parametrize(
    ("fails", "likelier", "found", "levels"),
    [
        ({DESCRIBED: NONE}, DESCRIBED, SLID, 4),
        ({DESCRIBED: NONE, SLID: NONE}, DESCRIBED, DESCRIBED, 1),
        ({DESCRIBED: LAST}, DESCRIBED, SLID, 4),
        ({DESCRIBED: LAST, SLID: LAST}, DESCRIBED, DESCRIBED, 3),
        ({DESCRIBED: THIRD}, DESCRIBED, DESCRIBED, 4),
        ({}, DESCRIBED, DESCRIBED, 4),
        ({}, SLID, SLID, 4),
        # All that is usual is lost: the search begins with more process noise, and ends at the last that holds.
        ({DESCRIBED: fitting.MISSED, SLID: fitting.MISSED}, DESCRIBED, DESCRIBED, 0),
    ],
)
def test_the_likelier_solution_is_followed_unless_the_other_one_leads_further(fails, likelier, found, levels):
    def solve(start, missed):
        """A solution that stays where it began."""
        place = float(start[0])
        errors = np.array([1.9 if missed in fails.get(place, ()) else 0.7])
        return fitting.Level(start, None, errors, missed, -2.0 if place == likelier else -1.0)

    solution, _ = fitting.solved(solve, np.array([[DESCRIBED], [SLID]]), fitting.levels(1e-7, 5e-4))
    assert solution.vector == [found] and solution.missed == (fitting.MISSED[levels - 1] if levels else 3e-5)


@pytest.mark.parametrize(("slid", "expected"), [(np.array([SLID]), [DESCRIBED, SLID]), (None, [DESCRIBED])])
def test_the_search_begins_at_the_description_and_at_what_sliding_alone_says(monkeypatch, slid, expected):
    begun = []

    def solved(solve, begins, *_):
        begun.extend(begins)
        raise IdentificationError("far enough")

    monkeypatch.setattr(fitting, "Search", lambda *_: SimpleNamespace(solve=None))
    monkeypatch.setattr(fitting, "sliding_start", lambda *_: slid)
    monkeypatch.setattr(fitting, "solved", solved)
    described = SimpleNamespace(start=np.array([DESCRIBED]))
    with pytest.raises(IdentificationError, match="far enough"):
        fitting.fit(SimpleNamespace(period_ns=500_000), None, described, 1e-7)
    assert begun == expected


def test_forces_need_a_scale_so_mass_or_turns_must_be_known():
    with pytest.raises(IdentificationError, match=r"platform.mass or actuator.turns .* common factor"):
        unknowns(StageParameters(), ["friction.coulomb"])
    with pytest.raises(IdentificationError, match=r"'weight': is not among the unknowns; allowed: platform.mass,"):
        unknowns(StageParameters(), ["weight"])


def test_the_model_resolves_stiff_bristles_under_a_light_platform_as_the_simulated_machine_does():
    stiff = dataclasses.replace(START.friction, bristle_stiffness=1e9)
    stage = dataclasses.replace(START, platform=dataclasses.replace(START.platform, mass=0.1), friction=stiff)
    searched = unknowns(stage, ["platform.mass"])
    state = plant_state(velocity=1e-6)
    advance(searched.constants(searched.start, 3000.0), state, 0.0, 0.0, 30_000_000)
    assert abs(state[1]) < 0.2e-6


@pytest.mark.parametrize(
    ("stiffness", "count", "travel"), [(1e6, 1e-7, 2e-6), (1e5, 1e-9, 2e-6), (1e7, 1e-9, 1.935e-7), (1e7, 5e-8, 1e-6)]
)
def test_a_platform_whose_friction_gives_way_sooner_may_move_less(stiffness, count, travel):
    friction = dataclasses.replace(START.friction, bristle_stiffness=stiffness)
    encoder = dataclasses.replace(START.encoder, y_resolution=count)
    assert least_travel(dataclasses.replace(START, friction=friction, encoder=encoder)) == pytest.approx(travel)


def test_a_slow_short_stage_without_friction_on_a_fine_encoder_is_found_within_its_intervals(tmp_path):
    slow = {"motion.speed": 0.05, "motion.acceleration": 0.5, "motion.stroke": 0.05, "platform.mass": 0.5}
    free = {"friction.coulomb": 0.0, "friction.static": 0.0, "friction.viscous": 0.5, "encoder.y_resolution": 1e-8}
    parameters = values({}, guide_file=str(tmp_path / "waves.csv"))
    parameters["stage"] |= {**slow, **free}
    survey, facts = excitation(StageParameters(motion=MotionParameters(speed=0.05, acceleration=0.5, stroke=0.05)))
    write_survey(tmp_path / "waves.csv", survey)
    parameters["stage"] |= facts
    bag = recorded_run(tmp_path / "bag", parameters)
    described = node_parameters("driver", parameters).stage
    start = dataclasses.replace(described, platform=dataclasses.replace(described.platform, mass=0.6))
    found = estimate_from_bag(bag, start, ["actuator.turns"]).parameters
    for name, truth in {"platform.mass": 0.5, "friction.viscous": 0.5, "friction.static": 0.0}.items():
        assert found[name].low <= truth <= found[name].high and not found[name].poor, name
    assert found["platform.mass"].high < 0.51


@pytest.mark.parametrize("resolution", [1e-7, 1e-9])
def test_a_fine_encoder_asks_for_a_model_that_is_as_exact(resolution):
    shipped, found = fitting.levels(1e-7, 5e-4), fitting.levels(resolution, 5e-4)
    assert shipped[-1] == 3e-7 and found[-1] == pytest.approx(3e-7 * resolution / 1e-7)
