import math

from straightcomp_ros.control.laws import OPEN_LOOP, ControlParameters, make_law
from straightcomp_ros.control.servo import AMPLIFIER_OFF, Servo
from straightcomp_ros.stage.description import StageParameters

T = 500_000
HELD = (1e-6, 0.0, 0.0)


def servo() -> Servo:
    return Servo(make_law(ControlParameters(law="linear"), StageParameters()))


def same(one, other):
    """To the last bit, and NaN equals NaN."""
    return repr(one) == repr(other)


def test_a_repeated_sample_gets_the_same_answer_and_changes_nothing():
    one, other = servo(), servo()
    for step in range(5):
        first = one.step(step * T, 1e-7 * step, 0.0, HELD)
        assert same(one.step(step * T, 1e-7 * step, 0.0, HELD), first)
        assert same(other.step(step * T, 1e-7 * step, 0.0, HELD), first)


def test_an_older_sample_is_refused():
    loop = servo()
    loop.step(10 * T, 0.0, 0.0, HELD)
    assert loop.step(9 * T, 0.0, 0.0, HELD) is None


def test_non_finite_samples_and_references_are_refused():
    loop = servo()
    for y, reference in ((math.nan, HELD), (math.inf, HELD), (0.0, (math.nan, 0.0, 0.0)), (0.0, (0.0, math.inf, 0.0))):
        assert loop.step(T, y, 0.0, reference) is None
    assert loop.step(T, 0.0, 0.0, HELD) is not None


def test_while_the_amplifier_is_off_nothing_is_integrated():
    waiting, fresh = servo(), servo()
    for step in range(1000):
        answer = waiting.step(step * T, 0.0, math.nan, HELD)
        assert answer is not None and answer.current == AMPLIFIER_OFF.current == 0.0
    assert same(waiting.step(1000 * T, 0.0, 0.0, HELD), fresh.step(0, 0.0, 0.0, HELD))


def test_after_a_long_gap_the_law_starts_anew():
    loop, fresh = servo(), servo()
    for step in range(100):
        loop.step(step * T, 0.0, 0.0, HELD)
    assert same(loop.step(100 * T + 10**9, 0.0, 0.0, HELD), fresh.step(0, 0.0, 0.0, HELD))


def test_after_a_clock_step_backward_the_law_starts_anew():
    loop, fresh = servo(), servo()
    for step in range(100):
        loop.step(10**12 + step * T, 0.0, 0.0, HELD)
    assert same(loop.step(10**6, 0.0, 0.0, HELD), fresh.step(0, 0.0, 0.0, HELD))


def test_in_open_loop_the_command_is_zero_and_the_error_is_told():
    loop = Servo(make_law(ControlParameters(law=OPEN_LOOP), StageParameters()))
    assert not loop.running
    answer = loop.step(T, 3e-6, 0.1, HELD)
    assert answer is not None and answer.current == 0.0 and answer.error == 1e-6 - 3e-6
    assert loop.running
