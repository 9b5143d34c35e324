"""Amplifier and delay are found from commands and measured currents, also where the latency jitters."""

import dataclasses
import math

import numpy as np
import pytest
from bag_of_rows import bag_of_rows
from scipy.stats import norm

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis import current_path as path_module
from straightcomp_ros.analysis.current_path import (
    Recording,
    current_path,
    huber_weights,
    read_recording,
    robust_regression,
)
from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.parameters.yaml_text import dump_yaml

DRIVE = DriveParameters()
PERIOD, RATE = 5e-4, 2.0 * math.pi * 500.0


def recorded(delays, rate=RATE, drive=DRIVE):
    """Random commands through a first-order amplifier; each takes effect ``delays`` (n,) s after its sample."""
    n = len(delays)
    command = np.array([drive.converted(value) for value in 0.05 * np.random.default_rng(1).standard_normal(n)])
    current, level, asked = np.empty(n), 0.0, 0.0
    events = sorted((k * PERIOD + delay, command[k]) for k, delay in enumerate(delays))
    for k in range(n):
        current[k], now = level, k * PERIOD
        while events and events[0][0] < (k + 1) * PERIOD:
            at, value = events.pop(0)
            level = asked + (level - asked) * math.exp(-rate * (at - now))
            asked, now = value, at
        level = asked + (level - asked) * math.exp(-rate * ((k + 1) * PERIOD - now))
    return Recording(round(PERIOD * 1e9), np.zeros(n), np.zeros(n), current, command, n)


LATE = np.random.default_rng(5).choice(20_000, 40, replace=False)
COMMANDED = 0.05 * np.random.default_rng(1).standard_normal(4000)
LOST = np.append(5.0, [DRIVE.converted(one) for one in COMMANDED[1:]])
"""The first command stands for those before the stretch too."""


@pytest.mark.parametrize("hertz", [250.0, 1000.0])
@pytest.mark.parametrize(
    ("samples", "late", "described", "command"),
    [
        *((one, [], {}, None) for one in (0.34, 0.95, 1.0, 1.05, 1.9)),
        pytest.param(1.0, LATE, {}, None, id="a few late commands"),
        pytest.param(4.5, [], {"delay": 2.5}, None, id="two samples more than described"),
        pytest.param(0.4, [], {"dac_bits": 6}, COMMANDED, id="a coarse converter makes something else of commands"),
        pytest.param(1.0, [], {}, LOST, id="one command that never came"),
    ],
)
def test_bandwidth_and_delay_are_found_on_both_sides_of_the_next_sample(samples, late, described, command, hertz):
    drive = dataclasses.replace(DRIVE, **described)
    delays = np.full(20_000 if len(late) else 4000, samples * PERIOD)
    delays[late] = 1.9 * PERIOD
    run = recorded(delays, 2.0 * math.pi * hertz, drive)
    path = current_path(run if command is None else dataclasses.replace(run, command=command), drive)
    assert path.rate_found
    assert path.rate == pytest.approx(2.0 * math.pi * hertz, rel=1e-3 if len(late) else 1e-6)
    assert path.delay == pytest.approx(samples * PERIOD, abs=1e-7)
    assert len(late) or path.delay_spread == pytest.approx((path.delay, path.delay), abs=1e-7)
    assert samples >= 1.0 or path.after[5:-5] == pytest.approx(run.command[5:-5], abs=1e-12)


def test_the_deviation_of_the_bandwidth_is_that_of_many_noisy_records():
    clean, noise = recorded(np.full(4000, 6e-4)), np.random.default_rng(4)
    commands = (clean.command + 2e-4 * noise.standard_normal(4000) for _ in range(40))
    found = [current_path(dataclasses.replace(clean, command=command), DRIVE) for command in commands]
    spread = np.std([path.rate for path in found])
    assert 0.7 < np.median([path.rate_deviation for path in found]) / spread < 1.4


def test_a_jittering_latency_is_found_sample_by_sample():
    recording = recorded(np.random.default_rng(2).uniform(3.5e-4, 6.5e-4, 4000))
    path = current_path(recording, DRIVE)
    assert path.delay == pytest.approx(5e-4, abs=5e-5)
    assert path.delay_spread == pytest.approx((3.65e-4, 6.35e-4), abs=5e-5)
    steps = np.diff(recording.current).std()
    switch = path.switch_ns * 1e-9
    middle = path.before + (recording.current - path.before) * np.exp(-path.rate * switch)
    # The current that the path leads to from each measured one, at the next sample.
    reached = path.after + (middle - path.after) * np.exp(-path.rate * (PERIOD - switch))
    assert (reached[:-1] - recording.current[1:]).std() < 0.2 * steps


def test_a_current_that_no_amplifier_explains_is_interpolated():
    recording = recorded(np.full(4000, 1e-4))
    noise = np.random.default_rng(3).standard_normal(4000)
    path = current_path(Recording(recording.period_ns, noise, noise, noise, recording.command, 4000), DRIVE)
    assert math.isnan(path.delay) and not path.rate_found
    charge = path.before * path.switch_ns + path.after * (recording.period_ns - path.switch_ns)
    np.testing.assert_allclose(charge[:-1], 0.5 * recording.period_ns * (noise[:-1] + noise[1:]))


def written(bag, y, current, streams=(ENCODER, COMMAND), lost=range(0), parameters="", back=0, silent=()):
    """A bag of encoder and command at 2 kHz, whose clock is set back by ``back`` samples in its middle; ``silent``
    samples have no command."""
    numbers = {ENCODER: lambda k: (0.0, y[k], math.nan, current[k]), COMMAND: lambda k: (1e-6 * k,)}
    stamp = lambda k: 10**9 + 500_000 * (k - back * (2 * k > len(y)))  # noqa: E731
    kept = ((stream, k) for k in range(len(y)) if k not in lost for stream in streams)
    kept = (one for one in kept if one[0] is not COMMAND or one[1] not in silent)
    return bag_of_rows(bag, ((stream, stamp(k), numbers[stream](k)) for stream, k in kept), parameters)


MOVING = 1e-5 * np.sin(np.arange(5000) / 100.0)
ON = np.full(5000, 0.01)


@pytest.mark.parametrize(
    ("y", "current", "others", "words"),
    [
        (MOVING, np.full(5000, math.nan), {}, "amplifier is off throughout .* record with the amplifier on"),
        (np.where(np.arange(5000) % 2, 1e-7, 0.0), ON, {}, "nothing moves: the platform stays within 0.1 µm.*>= 2 µm"),
        (MOVING, ON, {"streams": (ENCODER,)}, "no messages on 'command'"),
        (MOVING, ON, {"back": 1000}, "'encoder' go back by 0.5 s"),
        (MOVING[:3000], ON[:3000], {"lost": range(1500, 1510)}, "no sample lost has 1490 samples; allowed: >= 2000"),
    ],
    ids=["amplifier off", "nothing moves", "no commands", "clock set back", "a short stretch between losses"],
)
def test_a_bag_that_cannot_be_identified_is_refused(tmp_path, y, current, others, words):
    bag = written(tmp_path / "bag", y, current, **others)
    with pytest.raises(IdentificationError, match=words):
        read_recording(bag)


def test_a_platform_may_be_read_that_moves_as_little_as_its_stage_needs(tmp_path):
    assert read_recording(written(tmp_path / "bag", 0.05 * MOVING, ON), 9e-7).total == 5000


def test_the_longest_stretch_without_a_loss_is_used(tmp_path):
    recording = read_recording(written(tmp_path / "bag", MOVING, ON, lost=range(1000, 1001)))
    assert (len(recording.y), recording.total) == (5000 - 1001 - 10, 4999)
    np.testing.assert_allclose(recording.y, MOVING[1011:])
    assert recording.duration == pytest.approx(3989 * PERIOD)


def test_a_sample_without_a_command_has_the_one_before_and_none_before_the_first(tmp_path):
    silent = (*range(30), *range(2000, 2004))
    recording = read_recording(written(tmp_path / "bag", MOVING, ON, silent=silent))
    expected = 1e-6 * np.arange(5000.0)
    expected[:30], expected[2000:2004] = 0.0, 1999e-6
    assert recording.command == pytest.approx(expected[10:], abs=1e-12)


def test_weights_use_95_percent_of_the_information_of_normal_residuals_and_less_of_wild_ones():
    residuals = 3.0 * norm.ppf((np.arange(100_000) + 0.5) / 100_000)
    weights = huber_weights(residuals, 1e-9)
    # The efficiency of an M-estimate: of ψ(r) = w r, the squared mean of ψ' by the mean of ψ².
    kept = weights == 1.0
    assert 9.0 * kept.mean() ** 2 / np.mean((weights * residuals) ** 2) == pytest.approx(0.95, abs=1e-3)
    assert np.ptp((weights * np.abs(residuals))[~kept]) == pytest.approx(0.0, abs=1e-12)
    # Where most residuals are nothing, the least deviation counts.
    assert huber_weights(np.array([0.0, 0.0, 0.0, 13.45]), 1.0) == pytest.approx([1.0, 1.0, 1.0, 0.1])


@pytest.mark.parametrize(("wild", "within"), [(0, 2e-3), (200, 4e-3)])
def test_a_regression_finds_factors_and_their_residuals_whatever_a_few_wild_ones(wild, within):
    random = np.random.default_rng(1)
    terms, noise = random.standard_normal((20_000, 2)), 0.1 * random.standard_normal(20_000)
    noise[:wild] = 30.0
    found, deviation = robust_regression(terms, terms @ [2.0, -0.5] + noise, 1e-6)
    assert found == pytest.approx([2.0, -0.5], abs=within)
    assert deviation == pytest.approx(0.1 / math.sqrt(0.95), rel=0.03 + 5.0 * wild / 20_000)


def test_the_arrival_of_each_command_is_found_to_a_nanosecond_with_the_right_bandwidth():
    # So wide a jitter hides the bandwidth: the described one holds.
    delays = np.random.default_rng(2).uniform(0.1, 0.9, 500) * PERIOD
    run = recorded(delays)
    path = current_path(run, DRIVE)
    # But where the converter's counts make two commands the same one.
    inside = np.flatnonzero(np.abs(path.after - path.before) > 1e-9)[1:-1]
    assert inside.size > 480 and path.rate == RATE
    assert path.switch_ns[inside] == pytest.approx(1e9 * delays[inside], abs=1.0)
    assert path.after[inside] == pytest.approx(run.command[inside])
    assert path.before[inside] == pytest.approx(run.command[inside - 1])


def test_the_described_bandwidth_holds_where_the_record_gives_none():
    still = Recording(500_000, *np.zeros((4, 4000)), 4000)
    path = current_path(still, dataclasses.replace(DRIVE, bandwidth=300.0))
    assert (path.rate, path.rate_found, path.rate_deviation) == (2.0 * math.pi * 300.0, False, 0.0)
    assert math.isnan(path.delay) and np.isnan(path.delay_spread).all()
    # One that is faster than its samples show, with the noise of the measurement.
    for seed in range(4):
        fast, noise = recorded(np.full(4000, 1e-4), rate=1e6), np.random.default_rng(seed).standard_normal(4000)
        path = current_path(dataclasses.replace(fast, current=fast.current + 1e-5 * noise), DRIVE)
        assert path.rate > 0.0 and np.isfinite(path.before).all()
    # A gain that is not that of the description is another command's.
    weak = recorded(np.full(4000, 1e-4))
    assert not current_path(dataclasses.replace(weak, current=0.9 * weak.current), DRIVE).rate_found
    assert current_path(dataclasses.replace(weak, current=0.95 * weak.current), DRIVE).rate_found


def test_of_a_long_stretch_those_samples_are_used_in_which_the_platform_moves_whatever_flickers_at_rest(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(path_module, "LONGEST", 2000)
    random = np.random.default_rng(1)
    for size in (2015, 2050, 4000, 6007):
        y = 1e-6 * np.cumsum(random.standard_normal(size) ** 3) + 1e-3 * (np.arange(size) % 2)
        # Behind the samples after the switch-on, by the means of 10 ms.
        means = [y[at : at + 20].mean() for at in range(10, size - 19, 20)]
        ways = [sum(np.abs(np.diff(means[at : at + 100]))) for at in range(max(1, len(means) - 99))]
        # The current is the number of the sample.
        recording = read_recording(written(tmp_path / str(size), y, np.arange(size)))
        assert recording.current[0] == 10 + 20 * np.argmax(ways) and len(recording.y) == min(2000, size - 10)


NAMES = {"x.message": "Axes", "x.signal": "X", "y.signal": "Y", "current.signal": "Coil"}


@pytest.mark.parametrize(
    ("board", "lag"),
    [
        ({}, 0),
        ({"can.fd": False}, 1),
        (NAMES, 0),
        (NAMES | {"current.message": "Coils"}, 1),
        (NAMES | {"current.message": "Platform", "y.message": "Platform"}, 0),
    ],
)
def test_a_current_in_a_message_of_its_own_belongs_to_the_sample_before_whether_the_dbc_file_is_there_or_not(
    tmp_path, board, lag
):
    its_own = {"can.dbc": "nowhere.dbc", **{f"can.wire.{name}": value for name, value in board.items()}}
    driver = {"ros__parameters": {"hardware": "can", **(its_own if "x.signal" in board else board)}}
    # The current is the number of the sample.
    bag = written(tmp_path / "bag", MOVING, np.arange(MOVING.size), parameters=dump_yaml({"driver": driver}))
    recording = read_recording(bag)
    (first,) = np.flatnonzero(recording.y[0] == MOVING)
    assert (recording.current - np.arange(first, first + recording.y.size) == lag).all()
