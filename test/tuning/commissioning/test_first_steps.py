"""Before a loop is closed: all machines that the description allows pass, broken ones are named, and none moves far."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import broken
import numpy as np
import pytest
from roughly_known import MACHINES, TRUTH, values_of, work_on

from straightcomp_ros.control.excitation_parameters import ExcitationParameters
from straightcomp_ros.tuning.commissioning import LeftTravel
from straightcomp_ros.tuning.commissioning.machine import Series, SimulatedMachine
from straightcomp_ros.tuning.commissioning.open_loop import connection, signs_and_scales
from straightcomp_ros.tuning.commissioning.step import Outcome


@pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES)
def test_a_machine_that_the_description_allows_passes(machine: dict[str, float], tmp_path: Path) -> None:
    work = work_on(values_of(machine), tmp_path)
    assert connection(work).passed
    outcome = signs_and_scales(work)
    assert outcome.passed, outcome.sentence
    assert outcome.stage["drive.bandwidth"] == pytest.approx(500.0 * machine.get(f"{TRUTH}amplifier", 1.0), rel=1e-6)
    assert outcome.stage["drive.delay"] == pytest.approx(machine.get("stage.drive.delay", 1.0), rel=1e-6)
    assert outcome.figures["farthest_um"] < 50.0


@pytest.mark.parametrize(
    ("wiring", "words"),
    [
        (broken.readback_backwards, "readback is wired backwards"),
        (broken.readback_of_half_the_scale, "readback shows 0.5 times the commanded current"),
        (broken.readback_dead, "the measured current does not answer"),
        (broken.readback_with_an_offset, "the readback shows 100 mA without a command"),
        (broken.encoder_backwards, "a positive current moves the platform toward negative y"),
        (broken.encoder_dead, "do not move the platform"),
    ],
    ids=[
        "readback backwards",
        "readback of half the scale",
        "readback dead",
        "readback with an offset",
        "encoder backwards",
        "encoder dead",
    ],
)
def test_wrong_wiring_is_named_before_the_loop_is_closed(wiring, words: str, tmp_path: Path) -> None:
    work = work_on(values_of(), tmp_path, wiring)
    assert connection(work).passed
    outcome = signs_and_scales(work)
    assert not outcome.passed and words in outcome.sentence


@pytest.mark.parametrize(
    ("machine", "words"),
    [
        ({f"{TRUTH}amplifier": 0.1}, "the amplifier has 50 Hz, 0.1 times what is described"),
        ({"stage.drive.delay": 2.2}, "commands act 2.20 samples after theirs"),
    ],
)
def test_a_machine_that_is_not_as_described_is_named(machine: dict[str, float], words: str, tmp_path: Path) -> None:
    outcome = signs_and_scales(work_on(values_of(machine), tmp_path))
    assert not outcome.passed and words in outcome.sentence


def test_a_platform_that_something_pulls_is_named_within_milliseconds(tmp_path: Path) -> None:
    # As with one coil dead, the magnets do not balance where the platform is: far off the centre they pull as much.
    values = values_of({"simulated.initial_y": 5e-4}, uncertainty__force=0.1, uncertainty__air_gap=0.1)
    outcome = signs_and_scales(work_on(values, tmp_path))
    assert not outcome.passed and "the magnets do not balance" in outcome.sentence


def test_a_bus_that_loses_one_sample_in_a_hundred_is_named(tmp_path: Path) -> None:
    outcome = connection(work_on(values_of(), tmp_path, broken.lossy_bus))
    assert not outcome.passed and "of 60000 samples (" in outcome.sentence and "were lost" in outcome.sentence
    assert 500 < outcome.figures["lost_samples"] < 700


def listened(folder: Path, change: Callable[[Series], None]) -> Outcome:
    """The first step on a machine whose samples are changed."""
    work = work_on(values_of(), folder)
    series = work.machine.listen(5.0)
    change(series)

    class Heard(SimulatedMachine):
        def listen(self, seconds: float) -> Series:
            return series

    return connection(dataclasses.replace(work, machine=Heard(work.values)))


def test_samples_without_a_command_are_counted_except_at_the_ends_of_the_recording(tmp_path: Path) -> None:
    def ends(series: Series) -> None:
        for place in (slice(0, 3), slice(-6, None)):
            series.command[place] = series.latency[place] = np.nan

    def within(series: Series) -> None:
        ends(series)
        series.command[[100, 4000, 4001]] = np.nan

    sound = listened(tmp_path, ends)
    assert sound.passed and sound.figures["lost_commands"] == 0
    lacking = listened(tmp_path, within)
    assert not lacking.passed and lacking.figures["lost_commands"] == 3
    assert "3 of 10000 samples got no command" in lacking.sentence


def test_late_commands_of_a_busy_computer_are_not_lost_ones(tmp_path: Path) -> None:
    # As recorded: at a sample before which none arrived the driver tells no latency.
    def late(series: Series) -> None:
        series.latency[::12] = np.nan
        series.latency[1::12] = 1e-3

    assert listened(tmp_path, late).passed


def test_a_driver_at_which_no_command_arrives_is_named(tmp_path: Path) -> None:
    outcome = listened(tmp_path, lambda series: series.latency.fill(np.nan))
    assert not outcome.passed and "commands arrived at the driver between 0 % of the samples" in outcome.sentence
    outcome = listened(tmp_path, lambda series: series.command.fill(np.nan))
    assert not outcome.passed and "10000 of 10000 samples got no command" in outcome.sentence


def test_a_platform_that_strays_from_its_reference_ends_the_stroke(tmp_path: Path) -> None:
    # With half of the position fed back, the law is softer than the magnets' negative stiffness.
    values = values_of()
    values["controller"] |= {"control.law": "linear", "control.smc.natural_frequency": 14.0, "control.smc.phi": 13.8}
    machine = SimulatedMachine(values, broken.encoder_of_twice_the_count)
    with pytest.raises(LeftTravel, match=r"left its reference by \d+ µm under law 'linear' \(allowed: 200 µm\)"):
        machine.stroke(values, tmp_path / "bag", 2e-4)


def test_the_amplifier_is_off_as_soon_as_the_platform_has_left_the_travel() -> None:
    machine = SimulatedMachine(values_of())
    series = machine.play(ExcitationParameters(signal="ramp_up", current=0.4, duration=2.0, travel=3e-6))
    assert series.left_at is not None and len(series.y) < 4000
    off = series.left_at
    assert np.abs(series.y[:off]).max() <= 3e-6 < abs(series.y[off])
    assert np.isfinite(series.current[: off + 1]).all() and np.isnan(series.current[off + 1 :]).all()
    # Friction stops it, and nothing pulls any more.
    assert abs(series.y[-1]) < 2e-5 and np.ptp(series.y[-50:]) < 1e-7
