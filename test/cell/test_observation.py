"""What an observer of the graph finds in its streams, and what stands in the way of a cycle."""

import math
from dataclasses import replace

import pytest

from straightcomp_ros.cell.observation import Observation, StrokeErrors

MS = 1_000_000


def run(strokes, positions, error, position_at_once=1, error_at_once=1):
    """Add them in turns, so many of each at once."""
    samples = [(number * 4 * MS, x, error(number)) for number, x in enumerate(positions)]
    for number in range(len(samples) + position_at_once + error_at_once):
        at, late = number - number % position_at_once, number - number % error_at_once
        strokes.add(
            [(stamp, x) for stamp, x, _ in samples[at - position_at_once : at]] if number == at else [],
            [(stamp, each) for stamp, _, each in samples[late - error_at_once : late]] if number == late else [],
        )


def stroke(step, still, moving, margin):
    """Positions of a stroke of ``step`` (m) in each sample, at rest before and after it, and the errors meanwhile: 3 µm
    peak to peak ``margin`` samples away from its ends, more before it."""
    positions = [step * min(max(number - still, 0), moving) for number in range(2 * still + moving)]

    def error(number):
        inside = still + margin <= number < still + moving - margin
        return (1e-6 if number % 2 else -2e-6) if inside else (9e-6 if number < still else 0.0)

    return positions, error


@pytest.mark.parametrize(("positions_at_once", "errors_at_once"), [(1, 1), (450, 450), (450, 1), (1, 450), (150, 45)])
def test_the_error_of_a_movement_is_known_when_it_ends_and_rest_does_not_count(positions_at_once, errors_at_once):
    strokes = StrokeErrors()
    run(strokes, *stroke(2e-4, 100, 250, 50), positions_at_once, errors_at_once)
    assert strokes.still
    assert strokes.last_pp == pytest.approx(3e-6)


@pytest.mark.parametrize("speed", [1e-4, 1e-5, 2e-7])
def test_slow_strokes_are_seen_as_far_as_the_encoder_shows_them(speed):
    way, error = stroke(0.004 * speed, 3000, 6000, 1500)
    # The reading jumps by a count at rest.
    positions = [1e-7 * (round(x / 1e-7) + number % 2) for number, x in enumerate(way)]
    for samples, still, last_pp in ((6000, False, math.nan), (len(positions), True, 3e-6)):
        strokes = StrokeErrors()
        strokes.expect(speed, 1e-7)
        run(strokes, positions[:samples], error)
        assert strokes.still is still and strokes.last_pp == pytest.approx(last_pp, nan_ok=True)
    # What is left to others who look: beyond the noise, and far less than the stroke's way.
    way, seconds = strokes.rest
    assert 2e-7 < way < 0.5 * speed * seconds


def test_a_movement_of_which_samples_are_missing_is_one():
    strokes = StrokeErrors()
    for number in (*range(250, 300), *range(400, 450)):
        strokes.add([(number * 4 * MS, 0.0002 * number)], [(number * 4 * MS, 1e-6 * number)])
        assert not strokes.still or number < 251
    assert math.isnan(strokes.last_pp)


def test_neither_noise_of_the_encoder_nor_a_source_that_starts_anew_is_a_movement():
    strokes = StrokeErrors()
    run(strokes, [1e-7 * (k % 3) for k in range(500)], lambda k: 1.0)
    run(strokes, [0.5] * 50, lambda k: 0.0)
    assert strokes.still and math.isnan(strokes.last_pp)


WELL = Observation(nodes={"driver": "plain", "logger": "active"}, fresh=True, descriptions={"driver": "a", "cell": "a"})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        (
            {"nodes": {"driver": "absent", "logger": "absent"}},
            "nodes that do not work: driver (absent), logger (absent)",
        ),
        ({"nodes": {"driver": "inactive"}}, "driver (inactive)"),
        ({"fresh": False}, "no samples"),
        ({"still": False}, "moves"),
        ({"unrecorded": ("/encoder",)}, "/encoder"),
        ({"descriptions": {"driver": "a 12", "controller": "a 34"}}, "differ (controller a 34, driver a 12)"),
        ({"faults": {"driver": "coil"}}, "driver: coil"),
    ],
)
def test_what_is_in_the_way_of_a_cycle_is_named(changes, words):
    obstacle = replace(WELL, **changes).obstacle
    assert words in obstacle and bool(obstacle) is bool(changes)
