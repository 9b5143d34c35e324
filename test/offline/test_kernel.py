"""The compiled loop is the simulation, to the last bit."""

import dataclasses
import math
from dataclasses import fields
from typing import NamedTuple

import numpy as np
import pytest
from tiers import nightly

from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.laws import LAWS, ControlParameters, make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import kernel, make_scenario, references, run_cycle
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import can_run, compiled_cycle, run_stroke
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.feedforward import Feedforward, FeedforwardParameters
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey import Run, Survey

STAGE = StageParameters()

PERIOD = 500_000
MAP = load_map(MapParameters())


def steady(law, count: int, delays=PERIOD // 2, noise=0.0):
    """The cycle of a platform at rest on a reference of 1 µm."""
    references = np.tile([1e-6, 0.0, 0.0], (count, 1))
    given = np.arange(count) * PERIOD, np.full(count, delays), references, np.full(count, noise)
    return run_cycle(law, PlantParameters(), *given)


CYCLE = {"motion.stroke": 0.03, "motion.settle": 0.1, "motion.pause": 0.1}
DELAYS = (0.2, 0.5, 1.0, 1.5, 2.7)
BEYOND_LUGRE = {"bands.fraction": 0.3, "rest.growth": 0.2, "step.factor": 1.5, "step.time": 0.8}


def case(law="smc", stage=None, **others):
    return {"driver": {}, "controller": {"control.law": law}, "stage": {**CYCLE, **(stage or {})}, **others}


AWAY = {"simulated.initial_y": 2e-6, "simulated.truth.mass": 0.97}
CONTACTS = {
    model: {f"simulated.truth.contact.{name}": value for name, value in {"model": model, **BEYOND_LUGRE}.items()}
    for model in ("lugre", "maxwell_slip")
}
DISTURBED = {
    "simulated.truth.modes.first.frequency": 400.0,
    "simulated.truth.modes.first.coil": 0.2,
    "simulated.truth.modes.second.frequency": 700.0,
    "simulated.truth.modes.second.encoder": -0.1,
    **{
        f"simulated.truth.disturbances.{name}": value
        for name, value in {
            "mains.force": 0.1,
            "cogging.force": 0.2,
            "cable.drag": 0.1,
            "drift.current": 0.005,
            "vibration.acceleration": 0.01,
            "interpolation.amplitude": 4e-8,
        }.items()
    },
}
CASES = {
    **{f"{law}, {delay}": case(law, {"drive.delay": delay}, driver=AWAY) for law in LAWS for delay in DELAYS},
    **{f"friction {model}": case(driver=contact) for model, contact in CONTACTS.items()},
    "disturbed": case("smc_observer", {"motion.start": 0.1}, driver=DISTURBED),
    "fast ramps": case("smc_observer", {"motion.stroke": 0.3, "motion.acceleration": 10.0}),
    "another zero of x": case(
        stage={"motion.start": 0.1, "motion.stroke": 0.3},
        driver={"simulated.index_shift": 0.003, "simulated.referenced": False},
    ),
    "begins elsewhere": case(stage={"motion.start": 0.4}, feedforward={"stage.motion.speed": 0.01}),
}


OTHERS = {f"{law}, {delay}" for law in LAWS for delay in DELAYS if delay not in (0.5, 1.5)}


@pytest.mark.parametrize("name", [*(name for name in CASES if name not in OTHERS), *nightly(sorted(OTHERS))])
def test_a_compiled_cycle_is_the_simulation_in_every_column(name):
    values = CASES[name]
    assert can_run(values)
    record, straightness = run_stroke(values)
    simulation = Simulation(values)
    assert record.time.size > 3000 and straightness.span == simulation.map.span
    coils: list[float] = []
    expected = simulation.run(observe=lambda sample, *_: coils.append(sample.current))
    for field in fields(expected):
        np.testing.assert_array_equal(getattr(record, field.name), getattr(expected, field.name), field.name)
    np.testing.assert_array_equal(compiled_cycle(values)[2].coil_current, coils)


def test_what_the_compiled_cycle_does_not_model_is_left_to_the_simulation():
    values = case(stage={"drive.delay": 4.0})
    assert can_run(values)
    values["driver"]["simulated.command_timeout"] = 0.002
    assert not can_run(values)
    values["stage"]["drive.delay"] = 0.5
    assert can_run(values)
    values["controller"]["learning.learn"] = True
    assert not can_run(values)


def test_delays_are_those_of_the_first_commands_and_the_rest_have_the_constant_one():
    values = case(stage={"motion.stroke": 0.1, "drive.delay": 1.0})
    constant, _ = run_stroke(values)
    n = constant.time.size
    same, _ = run_stroke(values, np.full(100, PERIOD))
    np.testing.assert_array_equal(same.true_y, constant.true_y)
    # In a stroke: at rest all commands are the same.
    one = n // 3
    late, _ = run_stroke(values, np.where(np.arange(2 * n) == one, 3 * PERIOD, PERIOD))
    np.testing.assert_array_equal(late.true_y[:one], constant.true_y[:one])
    assert (late.true_y[one:] != constant.true_y[one:]).any()


def test_commands_with_a_delay_of_their_own_take_effect_as_on_the_simulated_board():
    delays = np.random.default_rng(5).integers(0, 4 * PERIOD, 400)
    hardware = SimulatedHardware(SimulatedParameters(), from_mapping(StageParameters, {"drive.delay": 0.0}), MAP)
    servo = Servo(make_law(ControlParameters(), STAGE))
    hardware.enable()
    hardware.start(0)
    positions = []
    for k, delay in enumerate(delays.tolist()):
        sample, truth = hardware.read(k * PERIOD)[-1]
        positions.append(truth.y)
        command = servo.step(sample.stamp_ns, sample.y, sample.current, (1e-6, 0.0, 0.0))
        hardware.write(command.current, sample.stamp_ns + delay)
    cycle = steady(make_law(ControlParameters(), STAGE), 400, delays=delays)
    np.testing.assert_array_equal(cycle.true_y, positions)


def test_references_of_a_cycle_are_those_of_the_feedforward_to_the_last_bit():
    random = np.random.default_rng(6)
    stamps = np.arange(3000) * PERIOD + random.integers(-20_000, 20_001, 3000)
    x = 0.3 + 0.1 * np.cumsum(np.diff(stamps, prepend=0)) * 1e-9
    stamps[1000:] += 80_000_000  # a gap longer than restart_gap
    x[2000:] += 0.05  # a jump that no stage makes
    feedforward = Feedforward(MAP)
    expected = [feedforward.step(stamp, at) for stamp, at in zip(stamps.tolist(), x.tolist(), strict=True)]
    np.testing.assert_array_equal(references(MAP, FeedforwardParameters(), STAGE, stamps, x), expected)


@pytest.mark.parametrize(("acceleration", "speed", "apart"), [(40.0, 0.3, 0.0), (10.0, 1.3, 0.0), (10.0, 1.0, 0.5e-6)])
def test_a_reference_of_a_while_ago_errs_by_what_the_stage_says_at_most_and_with_enough_lead_by_no_count(
    acceleration, speed, apart
):
    stage = {"motion.stroke": 1.0, "motion.speed": speed, "motion.acceleration": acceleration}
    shifted = [
        dataclasses.replace(one, deviation=one.deviation + apart * (one.direction == "forward"))
        for one in MAP.survey.runs
    ]
    for values in ({}, {"encoder.y_resolution": 1e-8}):
        scenario = make_scenario(case(stage={**stage, **values}), ["smc"])
        scenario = dataclasses.replace(scenario, survey=Survey(tuple(shifted)))
        stroke, described, lead = scenario.stroke(), scenario.followed, scenario.lead_ns * 1e-9
        found = np.abs(stroke.given[:, 0] - stroke.references[:, 0]).max()
        # The steepest place, the most curved one and the ramps need not meet; tracking adds its share.
        assert 0.4 <= found / described.outdated(stroke.map, lead) <= 1.2
        enough = described.enough_lead(stroke.map, lead)
        assert (enough < lead) == bool(values or apart)
        assert described.outdated(stroke.map, enough) <= described.encoder.y_rounding


def test_a_reference_of_a_while_ago_errs_as_much_on_a_stage_that_counts_backwards():
    ways = {"forward": "backward", "backward": "forward"}
    runs = [Run(one.name, ways[one.direction], -one.x[::-1], one.deviation[::-1]) for one in MAP.survey.runs]
    guides = {1.8: MAP, -1.8: StraightnessMap(Survey(tuple(runs)))}
    errors = [from_mapping(StageParameters, {"motion.stroke": way}).outdated(guides[way], 0.01) for way in guides]
    assert errors[0] == pytest.approx(errors[1], rel=1e-6)


def test_noise_reaches_the_encoder_and_not_the_platform_and_a_law_starts_anew_in_each_cycle():
    noise, law = 3e-6 * (np.arange(50) == 49), make_law(ControlParameters(), STAGE)
    quiet, disturbed = (steady(law, 50, noise=one) for one in (0.0 * noise, noise))
    np.testing.assert_array_equal(quiet.true_y, disturbed.true_y)
    np.testing.assert_array_equal(quiet.current[:49], disturbed.current[:49])
    assert disturbed.y[49] - quiet.y[49] == pytest.approx(3e-6, abs=1e-7)


def test_a_current_that_is_no_number_ends_the_cycle():
    class Count(NamedTuple):
        samples: float

    @compilable
    def step(gains, state, y, r, r_dot, r_ddot, measured):
        current = math.nan if state.samples > 6.5 else 0.0
        return Count(state.samples + 1.0), Command(current, r - y, 0.0, 0.0, 0.0, 0.0, 0.0)

    cycle = steady(Law(Count(0.0), lambda y: Count(0.0), step), 20)
    assert cycle.true_y.size == cycle.y.size == cycle.current.size == 7
    assert np.isfinite(cycle.current).all()
    # Another process may not be able to import this law.
    assert kernel(step).dispatcher.stats.cache_path is None
