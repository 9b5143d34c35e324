"""Before a loop is closed: all machines that the description allows pass, broken ones are named, and none moves far."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from roughly_known import (
    MACHINES,
    encoder_backwards,
    encoder_dead,
    encoder_of_twice_the_count,
    lossy_bus,
    noisy_encoder,
    one_coil_dead,
    readback_backwards,
    readback_dead,
    readback_of_half_the_scale,
    readback_with_an_offset,
    values_of,
    work_on,
)

from straightcomp_ros.control.excitation import ExcitationParameters
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.tuning.commissioning import LeftTravel, open_loop
from straightcomp_ros.tuning.commissioning.machine import Series, SimulatedMachine
from straightcomp_ros.tuning.commissioning.open_loop import connection, current_readback, signs_and_scales

PERIOD = 5e-4
COMMANDS = np.repeat(np.random.default_rng(3).uniform(-0.005, 0.005, 250), 2) * np.tile([1.0, -1.0], 250)
ENDS = [*range(3), *range(-6, 0)]
"""Of a recording."""
FAR_OFF, FREE = {"simulated.initial_y": 5e-4}, {"friction__coulomb": 0.0, "friction__static": 0.0}


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Five seconds of samples for the connection."""
    monkeypatch.setattr(open_loop, "_LISTEN", 5.0)


@pytest.mark.parametrize(("machine", "bits"), [*((one, 12) for one in MACHINES.values()), ({}, 7), ({}, 6)])
def test_a_machine_that_the_description_allows_passes_also_with_a_coarse_converter(machine, bits, tmp_path):
    work = work_on(values_of(machine, drive__dac_bits=bits), tmp_path)
    assert connection(work).passed
    outcome = signs_and_scales(work)
    assert outcome.passed, outcome.sentence
    assert outcome.figures["readback_gain"] == pytest.approx(1.0)
    assert outcome.stage["drive.bandwidth"] == pytest.approx(500.0 * machine.get("amplifier", 1.0), rel=1e-6)
    assert outcome.stage["drive.delay"] == pytest.approx(machine.get("stage.drive.delay", 1.0), rel=1e-6)
    assert outcome.figures["farthest_um"] < 50.0


@pytest.mark.parametrize(
    ("values", "wiring", "words"),
    [
        (values_of(), readback_backwards, "readback is wired backwards"),
        (values_of(), readback_of_half_the_scale, "shows 0.5 times the commanded current"),
        (values_of(), readback_dead, "the measured current does not answer"),
        (values_of(), readback_with_an_offset, "the readback shows 100 mA without a command"),
        (values_of(), encoder_backwards, "a positive current moves the platform toward negative y"),
        (values_of(), encoder_dead, "do not move the platform"),
        (values_of(), one_coil_dead, "the magnets do not balance; look for a coil without current"),
        (values_of({"amplifier": 0.1}), None, "the amplifier has 50 Hz, 0.1 times what is described"),
        (values_of({"stage.drive.delay": 2.2}), None, "commands act 2.20 samples after theirs"),
        # It cannot overcome the described friction with half of its current.
        (values_of(drive__dac_range=0.1), None, "raise 'stage.actuator.current_limit'"),
        # Far off the centre the magnets pull as much as with one coil dead.
        (values_of(FAR_OFF, uncertainty__force=0.1, uncertainty__air_gap=0.1), None, "from y = 500 µm to the middle"),
        # Without friction nothing holds it; a light one leaves within few samples.
        (values_of({"simulated.initial_y": 3e-5}, **FREE), None, "from y = 30 µm to the middle"),
        (values_of(platform__mass=1.0, rate=1000, **FREE), None, "or raise 'stage.rate'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_machine_that_is_not_as_described_is_named(values, wiring, words, tmp_path):
    work = work_on(values, tmp_path, wiring)
    assert connection(work).passed
    outcome = signs_and_scales(work)
    assert not outcome.passed and words in outcome.sentence


@pytest.mark.parametrize(
    ("tilt", "wiring", "words"),
    [
        (0.0, lossy_bus, "were lost"),
        (0.0, noisy_encoder, "y moves by 5 counts RMS"),
        (0.05, None, "shakes or pulls the machine"),
    ],
)
def test_what_is_wrong_with_the_amplifier_off_is_named(tmp_path, tilt, wiring, words):
    outcome = connection(work_on(values_of({"simulated.truth.disturbances.tilt": tilt}), tmp_path, wiring))
    assert not outcome.passed and words in outcome.sentence
    assert (70 < outcome.figures["lost_samples"] < 130) is (wiring is lossy_bus)


@pytest.fixture(scope="module")
def silent():
    """Samples of a machine as described, with the amplifier off."""
    return SimulatedMachine(values_of()).listen(5.0)


# As recorded: at a sample before which no command arrived the driver records no latency.
@pytest.mark.parametrize(
    ("command", "latency", "words"),
    [
        ({np.nan: ENDS}, {np.nan: ENDS}, ""),
        ({np.nan: [*ENDS, 100, 4000, 4001]}, {np.nan: ENDS}, "3 of 10000 samples got no command"),
        ({np.nan: slice(None)}, {}, "10000 of 10000 samples got no command"),
        ({}, {np.nan: slice(0, None, 12), 1e-3: slice(1, None, 12)}, ""),
        ({}, {np.nan: slice(None)}, "commands arrived at the driver between 0 % of the samples"),
    ],
    ids=["none at the ends of the recording", "none within it", "none at all", "late ones", "no latency at all"],
)
def test_samples_without_a_command_are_counted_except_at_the_ends_and_late_commands_are_not_lost(
    tmp_path, monkeypatch, silent, command, latency, words
):
    series = dataclasses.replace(silent, command=silent.command.copy(), latency=silent.latency.copy())
    for column, changes in ((series.command, command), (series.latency, latency)):
        for value, places in changes.items():
            column[places] = value
    monkeypatch.setattr(SimulatedMachine, "listen", lambda self, seconds: series)
    outcome = connection(work_on(values_of(), tmp_path))
    assert outcome.passed is (not words) and words in outcome.sentence
    assert words or outcome.figures["lost_commands"] == 0


def test_a_platform_that_strays_from_its_reference_ends_the_stroke(tmp_path):
    # With half of the position fed back, the law is softer than the magnets' negative stiffness.
    values = values_of()
    values["controller"] |= {"control.law": "linear", "control.smc.natural_frequency": 14.0, "control.smc.phi": 13.8}
    machine = SimulatedMachine(values, encoder_of_twice_the_count)
    with pytest.raises(LeftTravel, match=r"left its reference by \d+ µm under law 'linear' \(allowed: 200 µm\)"):
        machine.stroke(values, tmp_path / "bag", 2e-4)


def test_the_amplifier_is_off_as_soon_as_the_platform_has_left_the_travel():
    machine = SimulatedMachine(values_of())
    series = machine.play(ExcitationParameters(signal="ramp_up", current=0.4, duration=2.0, travel=3e-6))
    assert series.left_at is not None and len(series.y) < 4000
    off = series.left_at
    assert np.abs(series.y[:off]).max() <= 3e-6 < abs(series.y[off])
    assert np.isfinite(series.current[: off + 1]).all() and np.isnan(series.current[off + 1 :]).all()
    # Friction stops it, and nothing pulls any more.
    assert abs(series.y[-1]) < 2e-5 and np.ptp(series.y[-50:]) < 1e-7


def answered(bandwidth, delay, late=()):
    """A readback of 0.9 times the current of a first-order amplifier, in steps of a hundredth of a sample. The commands
    ``late`` come half a sample later than the others."""
    fine = 100
    drive = DriveParameters()
    commands = np.repeat([drive.converted(command) for command in COMMANDS.tolist()], fine)
    acting = np.concatenate([np.zeros(round(delay * fine)), commands])[: commands.size]
    for place in late:
        due = place * fine + round(delay * fine)
        acting[due : due + fine // 2] = acting[due - 1]
    left, current, seen = math.exp(-2.0 * math.pi * bandwidth * PERIOD / fine), 0.0, []
    for place, command in enumerate(acting.tolist()):
        if place % fine == 0:
            seen.append(current)
        current = command + (current - command) * left
    none = np.zeros(COMMANDS.size)
    return Series(np.arange(COMMANDS.size), none, none, 0.9 * np.array(seen) + 1e-4, COMMANDS, none)


DELAYS = itertools.product([250.0, 1000.0], [0.0, 0.5, 0.95, 1.0, 1.05, 2.97], [()])
LATE = (50, 51, 130, 222, 223, 301, 390, 460)


@pytest.mark.parametrize(
    ("bandwidth", "delay", "late"), [*DELAYS, (250.0, 0.95, LATE), (350.0, 1.0, LATE), (1000.0, 1.4, LATE)]
)
def test_an_amplifier_is_found_on_both_sides_of_a_whole_sample_of_delay_whatever_a_few_late_commands(
    bandwidth, delay, late
):
    found = current_readback(answered(bandwidth, delay, late), DriveParameters(), PERIOD)
    exact = 1e-3 if late else 1e-6
    assert found.gain == pytest.approx(0.9, rel=exact) and (late or found.offset == pytest.approx(1e-4, rel=exact))
    assert found.bandwidth == pytest.approx(bandwidth, rel=5e-3 if late else 1e-5)
    assert found.delay == pytest.approx(delay, abs=5e-3 if late else 1e-5)


@pytest.mark.parametrize(("wiring", "words"), [(None, ""), (encoder_backwards, "wired backwards")])
def test_a_push_against_a_flexure_shows_the_sign_before_it_swings_back(tmp_path, wiring, words):
    for stiffness in (5e3, 1.5e4, 4e4, 1.5e5):
        values = values_of(platform__stiffness=stiffness, platform__damping=2.0, **FREE)
        outcome = signs_and_scales(work_on(values, tmp_path, wiring))
        assert outcome.passed is (not words) and words in outcome.sentence


@pytest.mark.parametrize(
    ("bandwidth", "delay", "found"),
    [
        (1e4, 1.0, 1.0),
        # So quick an amplifier is through with a command at the next sample, whenever it came.
        (5e4, 0.6, 0.0),
        (500.0, 0.0, 0.0),
        (500.0, 8.5, 8.5),
        (500.0, 10.0, 10.0),
    ],
)
def test_an_amplifier_that_is_too_fast_for_the_samples_and_any_described_delay_are_no_fault(
    tmp_path, bandwidth, delay, found
):
    work = work_on(values_of(drive__bandwidth=bandwidth, drive__delay=delay, uncertainty__amplifier=1.0), tmp_path)
    outcome = signs_and_scales(work)
    assert outcome.passed, outcome.sentence
    assert outcome.figures["delay_samples"] == pytest.approx(found, abs=1e-5)
    assert outcome.figures["amplifier_bandwidth_Hz"] == pytest.approx(min(bandwidth, 5.0 / (2.0 * math.pi * PERIOD)))
    drive = work.given("stage", outcome.stage).stage.drive
    assert (drive.bandwidth, drive.delay) == pytest.approx((bandwidth, delay), abs=1e-5)
    assert ("drive.delay" in outcome.stage) is (bandwidth < 1e3)


class PulledAway:
    """A machine whose platform leaves before the current of ``signal`` begins."""

    def __init__(self, machine, signal):
        self.machine, self.signal = machine, signal

    def play(self, excitation):
        series = self.machine.play(excitation)
        if excitation.signal != self.signal:
            return series
        return dataclasses.replace(series, command=np.zeros_like(series.command), left_at=60)


@pytest.mark.parametrize("signal", ["shake", "ramp_up"])
def test_a_platform_that_nothing_holds_before_the_current_comes_is_not_taken_for_wired_wrongly(tmp_path, signal):
    work = work_on(values_of(**FREE), tmp_path)
    outcome = signs_and_scales(dataclasses.replace(work, machine=PulledAway(work.machine, signal)))
    assert not outcome.passed and "magnets do not balance" in outcome.sentence


@pytest.mark.parametrize("stop", [5e-4, 1e-5])
def test_a_platform_without_friction_coasts_slowly_and_not_into_its_stop(tmp_path, stop):
    outcome = signs_and_scales(work_on(values_of(platform__stop=stop, **FREE), tmp_path))
    assert outcome.passed is (outcome.figures["farthest_um"] < min(25.0, stop * 1e6 - 0.1))
