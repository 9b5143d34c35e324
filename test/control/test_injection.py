"""A test signal is added within its limits, and ends at zero."""

import math

import numpy as np
import pytest

from straightcomp_ros.control.excitation import Injection
from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.servo import Servo

FLAT = np.full(1000, 0.2)


def made(currents: np.ndarray = FLAT, **changed: float) -> Injection:
    return Injection(currents, **{"fade": 100, "limit": 0.9, "travel": 1e-4, **changed})  # type: ignore[arg-type]


def answers(injection: Injection, count: int, command: float = 0.0) -> np.ndarray:
    return np.array([injection.step(command, 0.0) for _ in range(count)])


def test_the_signal_rises_from_zero_and_ends_at_zero() -> None:
    injection = made()
    added = answers(injection, 1200)
    assert added[0] == pytest.approx(0.002) and added[998] == pytest.approx(0.002) and added[999] == 0.0
    assert np.abs(np.diff(added)).max() <= 0.002 + 1e-12
    assert (added[100:900] == 0.2).all() and (added[1000:] == 0.0).all()
    assert injection.finished and injection.stopped == ""


def test_beyond_the_travel_the_signal_fades_out_at_once_and_says_why() -> None:
    injection = made()
    answers(injection, 500)
    injection.step(0.0, -1.1e-4)
    fading = answers(injection, 200)
    assert "y − r changed by 110 µm; allowed: 100 µm" in injection.stopped
    assert np.abs(np.diff(fading)).max() <= 0.002 + 1e-12 and (fading[99:] == 0.0).all()
    assert injection.finished


def test_travel_counts_from_where_the_signal_began() -> None:
    injection = made()
    for _ in range(100):
        injection.step(0.0, 5e-3)
    assert not injection.stopped
    injection.step(0.0, 5e-3 - 1.1e-4)
    assert injection.stopped


def test_an_error_that_is_no_number_ends_the_signal_too() -> None:
    injection = made()
    injection.step(0.0, math.nan)
    assert injection.stopped


def test_command_and_signal_together_stay_within_the_limit() -> None:
    injection = made(limit=0.5)
    total = answers(injection, 1000, command=0.4)
    assert total.max() == 0.5 and injection.clipped > 800
    assert answers(made(-FLAT, limit=0.5), 1000, command=-0.4).min() == -0.5


@pytest.mark.parametrize("changed", [{"fade": 0}, {"fade": 501}])
def test_a_fade_that_does_not_fit_is_refused(changed: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="allowed: 1 to 500"):
        made(**changed)


def test_a_signal_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        made(np.full(1000, math.nan))


def still(gains: tuple[float], state: tuple[float], *numbers: float) -> tuple[tuple[float], Command]:
    return state, Command(0.1, numbers[1] - numbers[0], 0.0, 0.1, 0.0, 0.0, math.nan)


def test_the_servo_adds_the_signal_to_the_command_and_leaves_what_the_law_asked_for() -> None:
    servo = Servo(Law((0.0,), lambda y: (0.0,), still))
    servo.inject(made(fade=1))
    command = servo.step(0, 0.0, 0.0, (0.0, 0.0, 0.0))
    assert command is not None
    assert command.current == pytest.approx(0.3)
    assert command.equivalent_current + command.switching_current == pytest.approx(0.1)


def test_a_repeated_sample_takes_no_second_step_of_the_signal() -> None:
    servo = Servo(Law((0.0,), lambda y: (0.0,), still))
    servo.inject(made(np.arange(1000.0) / 1e4, fade=1))
    first = servo.step(0, 0.0, 0.0, (0.0, 0.0, 0.0))
    assert servo.step(0, 0.0, 0.0, (0.0, 0.0, 0.0)) == first
    second = servo.step(500_000, 0.0, 0.0, (0.0, 0.0, 0.0))
    assert second is not None and second.current == pytest.approx(0.1 + 1e-4)


def test_with_the_amplifier_off_the_signal_is_forgotten_and_says_so() -> None:
    servo = Servo(Law((0.0,), lambda y: (0.0,), still))
    injection = made(fade=1)
    servo.inject(injection)
    for stamp_ns, current in ((0, 0.0), (500_000, math.nan), (1_000_000, 0.0)):
        command = servo.step(stamp_ns, 0.0, current, (0.0, 0.0, 0.0))
    assert command is not None and command.current == pytest.approx(0.1)
    assert injection.stopped == "the amplifier was off, or samples were missing"
