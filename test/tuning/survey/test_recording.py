"""Surveys with known guides, hysteresis and faults: what is recognised, rejected, reported and written."""

import itertools
import struct
from functools import partial

import numpy as np
import pytest
from bag_of_rows import bag_of_rows
from places import BAGS

from straightcomp_ros.analysis.map_building import Choices, disagreement
from straightcomp_ros.bags import noting_warnings
from straightcomp_ros.bags.fields import Field
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import DISPLACEMENT, ENCODER
from straightcomp_ros.messages.cdr import ENCAPSULATION, joint_state
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.tuning.survey.recording import (
    Sensor,
    Series,
    build_from_series,
    recognise,
    series_of_bag,
    series_of_csv,
    spikes,
)
from trials.noise import mapped, surveyed

CHOICES = Choices(step=10e-3, limit=6.0, level=False)
SAMPLE = BAGS / "survey"
LENGTH = 0.4
START_NS = 1_700_000_000_000_000_000
SPEED = 0.2
"""m/s."""


def guide(x):
    return 5e-6 * np.sin(2.0 * np.pi * x / 0.3)


def driven(*ends, rate=200.0, rest=0.3):
    """time, x: from end to end at constant speed, resting at each."""
    x = [np.full(round(rest * rate), ends[0])]
    for start, end in itertools.pairwise(ends):
        count = round(abs(end - start) / SPEED * rate)
        x += [start + (end - start) * np.arange(1, count + 1) / count, np.full(round(rest * rate), end)]
    x = np.concatenate(x)
    return np.arange(x.size) / rate, x


def series(time, x, deviation=None):
    """Of :func:`guide`, or of another ``deviation``."""
    return Series("made up", time, x, guide(x) if deviation is None else deviation, 0, {})


def there_and_back(count):
    """That many places at which the stage stops on its way, and all its stops out and back."""
    stops = np.linspace(0.0, LENGTH, count)
    return stops, [*stops, *stops[-2::-1]]


def assert_points_at(stops, recording, names=("1 forward", "1 backward"), within=1e-9, error=1e-12):
    """In a recording the runs of these names, and no others, have their points ``within`` so much of the ``stops``, and
    the deviations there."""
    passages, partial = recognise(recording, 5e-3, 6.0)
    assert [f"{passage.run.name} {passage.run.direction}" for passage in passages] == [*names] and partial == 0
    for passage in passages:
        assert passage.at_rest and passage.run.x == pytest.approx(stops, abs=within)
        assert passage.run.deviation == pytest.approx(guide(stops), abs=error)


def test_clean_noise_is_hardly_ever_an_outlier():
    random = np.random.default_rng(1)
    assert spikes(random.normal(0.0, 1e-7, 20_000), 6.0).mean() < 1e-3
    rejected = [disagreement(random.normal(0.0, 1e-7, (count, 200)), 6.0) for count in (3, 4, 5, 10) for _ in range(10)]
    assert not any(one[0].any() for one in rejected)
    assert np.mean([one[1].mean() for one in rejected]) < 2e-3


def test_strokes_directions_and_a_broken_off_run_are_recognised():
    time, x = driven(0.0, LENGTH, 0.0, 0.15, 0.0, LENGTH, 0.0)
    passages, partial = recognise(series(time, x), 5e-3, 6.0)
    names = [(p.run.name, p.run.direction) for p in passages]
    assert names == [("1", "forward"), ("1", "backward"), ("2", "forward"), ("2", "backward")] and partial == 2
    for passage in passages:
        assert not passage.at_rest and passage.rejected_samples == 0
        assert passage.run.deviation == pytest.approx(guide(passage.run.x), abs=2e-8)


def test_a_spike_does_not_reach_the_points_even_where_a_point_has_one_reading():
    time, x = driven(0.0, LENGTH, rate=50.0)
    deviation = guide(x) + np.random.default_rng(3).normal(0.0, 1e-8, x.size)
    bad = np.arange(25, x.size - 20, 17)
    deviation[bad] += 3e-6
    ((passage,), _) = recognise(series(time, x, deviation), 4e-3, 6.0)
    assert passage.rejected_samples >= len(bad)
    assert np.abs(passage.run.deviation - guide(passage.run.x)).max() < 1e-7


def test_stops_make_points_of_their_second_halves():
    stops, ends = there_and_back(41)
    time, x = driven(*ends, rest=0.5)
    moving = np.abs(np.gradient(x, time)) > 1e-6
    # The probe still swings when the stage has stopped.
    settled_for = np.zeros(x.size)
    for i in range(1, x.size):
        settled_for[i] = 0.0 if moving[i] else settled_for[i - 1] + time[i] - time[i - 1]
    recording = series(time, x, guide(x) + 2e-6 * np.exp(-settled_for / 0.02))
    assert_points_at(stops, recording, error=2e-8)
    built, _ = build_from_series(recording, SAMPLE, CHOICES, {})
    assert built.straightness.span == pytest.approx((0.0, LENGTH))


def test_the_last_stop_ends_where_the_next_record_was_joined_to_it():
    stops, _ = there_and_back(41)
    x = np.tile(driven(*stops, rest=0.5)[1], 2)
    assert_points_at(stops, series(np.arange(x.size) / 200.0, x), ["1 forward", "2 forward"])


@pytest.mark.parametrize("period", [0.5, 0.04])
@pytest.mark.parametrize("samples_within", range(5))
def test_no_stop_is_lost_by_a_logger_that_has_few_samples_within_a_move(tmp_path, samples_within, period):
    (stops, ends), path = there_and_back(9), tmp_path / "slow.csv"
    _, x = driven(*ends, rate=(samples_within + 1) * SPEED / stops[1] * 0.999, rest=5.0)
    rows = (f"{period * k},{a * 1e3},{guide(a) * 1e6}\n" for k, a in enumerate(x))
    path.write_text("time_s,x_mm,deviation_um\n" + "".join(rows))
    assert_points_at(stops, series_of_csv(path))


def test_no_stop_is_lost_by_a_logger_for_which_a_move_ends_slowly():
    stops, places = there_and_back(21)
    x = np.repeat(places, 2)
    # Stands for 3.03 s, moves for 4 s.
    ends = 7.03 * (np.arange(x.size) // 2) + 3.03 * (np.arange(x.size) % 2)
    time = np.arange(0.013, ends[-1])
    assert_points_at(stops, series(time, np.interp(time, ends, x)), within=3e-4, error=2e-8)


def test_what_a_slow_logger_recorded_well_is_read_without_positions_between_its_samples():
    time, x = driven(0.0, LENGTH, 0.0, rate=2.0, rest=5.0)
    passages, _ = recognise(series(time, x), 5e-3, 6.0)
    assert [np.isin(passage.run.x.round(9), x.round(9)).all() for passage in passages] == [True, True]
    time, x = driven(*there_and_back(9)[1], rate=12.0, rest=3.0)
    # The reading before a move is wrong.
    x[np.flatnonzero(np.diff(x))[9] - 1] += 0.3
    passages, partial = recognise(series(time, x), 5e-3, 6.0)
    assert [passage.run.direction for passage in passages] == ["forward", "backward"] and partial == 0


def test_too_few_stops_are_refused_without_the_advice_that_is_for_runs_on_the_fly():
    time, x = driven(*there_and_back(12)[1])
    with pytest.raises(SurveyError, match=r"12 points; allowed: >= 20 \(min_points\)") as caught:
        build_from_series(series(time, x), SAMPLE, CHOICES, {})
    assert "step" not in str(caught.value)


@pytest.mark.parametrize("ends", [(0.2, 4, 0, 4, 0, 4, 0), (0, 4, 0, 3.75, 0, 4, 0), (0, 3.8, 0, 4, 0.3, 4, 0, 4, 0)])
def test_a_run_that_lacks_a_piece_of_a_long_stroke_is_partial_and_the_others_make_the_map(ends):
    time, x = driven(*ends)
    built, _ = build_from_series(series(time, x), SAMPLE, CHOICES, {})
    # What leads back from where a run was broken off lacks the same piece.
    whole = sum(abs(end - start) == 4 for start, end in itertools.pairwise(ends))
    assert built.counts["partial_runs"] == len(ends) - 1 - whole
    assert len(built.straightness.survey.runs) == whole
    assert built.straightness.span == pytest.approx((0.0, 4.0), abs=5e-3)


def test_of_three_runs_of_which_no_two_agree_in_their_ends_none_is_known_to_be_whole():
    time, x = driven(0.0, 4.0, 0.06, 4.06, 0.12, 4.12)
    with pytest.raises(SurveyError, match="allowed: within 50 mm"):
        build_from_series(series(time, x), SAMPLE, CHOICES, {})


DEMANDS = {
    # Points, length in m, amplitude in m, and what a stage's description says for such a guide.
    "travel": (81, 0.4, 250e-6, "travel: 3.0e-4"),
    "points": (12, 0.4, 5e-6, "min_points: 12"),
    "gaps": (41, 4.0, 5e-6, "max_gap: 0.1"),
}


@pytest.mark.parametrize(("points", "length", "amplitude", "fact"), DEMANDS.values(), ids=DEMANDS)
def test_the_map_s_tools_demand_of_a_survey_what_the_stage_does(
    tmp_path, monkeypatch, verb, points, length, amplitude, fact
):
    monkeypatch.chdir(tmp_path)

    def one(x):
        return amplitude * np.sin(2.0 * np.pi * x / (0.7 * length))

    for name, at in (("survey", np.linspace(0.0, length, points)), ("strokes", np.linspace(0.0, length, 400))):
        runs = tuple(Run("1", way, at, one(at)) for way in ("forward", "backward"))
        write_survey(f"{name}.csv", Survey(runs))
    described = ["guide.file: survey.csv", "guide.direction: both", f"guide.{fact}"]
    (tmp_path / "stage.yaml").write_text(
        "/**:\n  ros__parameters:\n" + "".join(f"    stage.{line}\n" for line in described)
    )
    of_stage = ["--stage-file", "stage.yaml", "--json"]
    assert verb("map", "build", "survey.csv", *of_stage).json["points"] == points
    assert verb("map", "align", "survey.csv", "strokes.csv", *of_stage).json["shift_mm"] == pytest.approx(0, abs=0.1)
    assert verb("map", "reverse", "survey.csv", "survey.csv", "-o", "g.csv", *of_stage).json["points"] == points
    # Both tables of the stage's map, of the stage's survey.
    exported = verb("map", "export", "-o", "t.comp", "--spacing", 50, *of_stage).json
    assert exported["directions"] == 2 and exported["survey"] == str(tmp_path / "survey.csv")
    # Without a stage nothing is known of a platform's travel.
    code = 0 if fact.startswith("travel") else 2
    for command in (["build", "survey.csv"], ["export", "-o", "u.comp", "--survey", "survey.csv", "--spacing", 50]):
        assert verb("map", *command).code == code
    (tmp_path / "small.yaml").write_text("/**:\n  ros__parameters:\n    stage.guide.travel: 1.0e-6\n")
    assert verb("map", "build", "strokes.csv", "--stage-file", "small.yaml").code == 1


def test_the_sample_survey_gives_the_guide_that_it_was_made_of(tmp_path, verb):
    output = tmp_path / "map.csv"
    found = verb("map", "build", SAMPLE, "-o", output, "--json").json
    assert (found["forward_runs"], found["backward_runs"]) == (5, 4)
    assert found["rejected_run_names"] == ["2 backward"]
    assert 10 <= found["rejected_samples"] <= 40
    assert 0.2 < found["repeatability_bidirectional_um"] < 0.6
    assert len(found["x_mm"]) == found["points"] == len(found["mean_um"])
    assert len(read_survey(output).runs) == 9
    head = output.read_text().splitlines()[:8]
    assert any(line.startswith("# source: survey, sha256 ") for line in head)
    assert any("rejected runs: 2 backward" in line for line in head)
    built, true = load_map(MapParameters(str(output))), load_map(MapParameters("config/guide_synthetic.csv"))
    x = np.linspace(0.002, 1.758, 1000)
    assert np.ptp(built.deviations(x) - true.deviations(x)) < 0.12e-6


def test_a_map_is_reported_with_its_band_and_smoothed_as_asked(tmp_path, verb):
    source, picture = tmp_path / "survey.csv", tmp_path / "survey.png"
    write_survey(source, surveyed(2e-3, 2e-7))
    figures = {}
    for how in ("auto", "none"):
        found = verb("map", "build", source, "--smooth", how, "--json").json
        figures[how], noise = found, mapped(read_survey(source), how).noise
        assert found["smoothed"] == (how == "auto") and f"stage.guide.smooth {how}" in found["provenance"]["choices"]
        assert found["map_uncertainty_95_um"] == pytest.approx(noise.half_width * 1e6, rel=1e-3)
        assert found["map_s_um"] == pytest.approx(noise.band(np.array(found["x_mm"]) * 1e-3) * 1e6, rel=1e-3)
    assert figures["none"]["map_um"] == pytest.approx(figures["none"]["mean_um"])
    assert figures["auto"]["map_um"] != pytest.approx(figures["auto"]["mean_um"], abs=0.1)
    code, _, said = verb("map", "build", source, "--smooth", "some")
    assert code == 2 and "allowed: auto, none or a number" in said
    code, _, said = verb("map", "build", source, "--plot", picture)
    assert code == 0 and "6 more runs" in " ".join(said.split()) and picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("time", ["", "time_s,"])
def test_the_sign_of_a_csv_file_is_turned_over_too_and_what_is_only_for_bags_is_refused(tmp_path, verb, time):
    source, output = tmp_path / "s.csv", tmp_path / "map.csv"
    stamped = zip(*driven(0.0, LENGTH, rest=0.3 if time else 0.0), strict=True)
    rows = [f"{f'{t:.3f},' if time else ''}{x * 1e3:.4f},{guide(x) * 1e6:.3f}" for t, x in stamped]
    source.write_text("\n".join([f"{time}x_mm,deviation_um", *rows]))
    means = [
        verb("map", "build", source, "-o", output, "--force", "--json", *word).json["mean_um"]
        for word in ([], ["--invert"])
    ]
    assert means[1] == pytest.approx([-one for one in means[0]]) and "# sign: inverted\n" in output.read_text()
    for options in ("--unit m", "--delay 0", "--on-platform", "--sensor probe", "--position axes"):
        code, _, said = verb("map", "build", source, *options.split())
        assert code == 2 and f"{options.split()[0]}: for bags" in said
    code, _, said = verb("map", "build", SAMPLE, "--x-column", "X [mm]")
    assert code == 2 and "--x-column: for CSV files" in said


@pytest.fixture
def build_other(tmp_path, verb):
    """Builds a map of a survey with other names and types: an axis `carriage`, a sensor without a stamp that counts µm
    downwards."""
    axes = joint_state(["spindle", "carriage"], position=["angle", "x"])
    with BagWriter(tmp_path / "bag") as bag:
        for topic, kind in (("/axes", axes.type_name), ("/probe", "std_msgs/msg/Float64")):
            bag.add(Topic(topic, kind))
        for t, x in zip(*driven(0.0, LENGTH, 0.0, rate=100.0), strict=True):
            ns = START_NS + round(t * 1e9)
            bag.write("/axes", axes.pack(ns, 1.0, x), ns, ns)
            bag.write("/probe", ENCAPSULATION + struct.pack("<d", -1e6 * guide(x)), ns, ns)
    stage = ["--stage", "axes:position[carriage]", "--unit", "um", "--json"]
    return partial(verb, "map", "build", tmp_path / "bag", *stage)


def test_topics_and_types_of_others_are_named_by_options(build_other):
    found = build_other("--invert", "--sensor", "/probe:data").json
    true = guide(np.array(found["x_mm"]) * 1e-3) * 1e6
    assert np.array(found["mean_um"]) == pytest.approx(true - true.mean(), abs=0.02)
    assert "by time of sending" in found["provenance"]["sensor"]


@pytest.mark.parametrize(
    "options, words",
    [
        (["--sensor", "/probe:q"], "no field 'q'"),
        (["--sensor", "/nothing:data"], "no topic '/nothing'"),
        (["--sensor", "/probe:data", "--stage", "axes:position[gantry]"], "no element 'gantry'"),
        (["--sensor", "/probe:po int"], "allowed: TOPIC or TOPIC:FIELD"),
    ],
)
def test_what_cannot_be_read_is_named(build_other, options, words):
    code, _, said = build_other(*options)
    assert code != 0 and words in " ".join(said.split())


SECOND = np.arange(0.0, 1.0001, 0.01)


@pytest.fixture
def read_bag(tmp_path):
    """A function: the series of a bag of a stage at x = SPEED t, sampled at ``stage_s``, and of ``reading(t)`` at
    ``readings_s``, as read with a ``sensor``."""
    count = itertools.count()

    def read(reading, stage_s=SECOND, readings_s=SECOND, y=lambda t: 0.0 * t, **sensor):
        rows = [(ENCODER, t, (SPEED * t, float(y(t)), np.nan, np.nan)) for t in stage_s]
        rows += [(DISPLACEMENT, t, (float(reading(t)),)) for t in readings_s]
        stamped = ((stream, START_NS + round(t * 1e9), numbers) for stream, t, numbers in rows)
        return series_of_bag(bag_of_rows(tmp_path / f"bag{next(count)}", stamped), sensor=Sensor(**sensor))

    return read


@pytest.mark.parametrize("delay", [0.0, 0.02, -0.02])
def test_a_reading_belongs_to_the_x_of_the_time_before_its_delay(read_bag, delay):
    # The sensor shows at t what was there at t − delay: with the right delay deviation and x agree again.
    found = read_bag(lambda t: 1e-6 * SPEED * (t - delay), delay=delay)
    assert found.deviation == pytest.approx(1e-6 * found.x, abs=1e-15)
    assert found.unusable == round(abs(delay) / 0.01)
    assert (f"{delay * 1e3:g} ms old" in found.inputs["sensor"]) is (delay != 0.0)


def test_the_platforms_y_is_that_of_the_readings_time_and_where_it_was_not_recorded_a_reading_says_nothing(read_bag):
    def y(t):
        return 3e-6 * t * t

    stage_s = np.arange(0.0, 1.0, 0.001)
    found = read_bag(lambda t: 1e-6 + y(t - 0.05), stage_s, y=y, delay=0.05, on_platform=True)
    assert found.deviation == pytest.approx(1e-6, abs=1e-11) and "on the platform" in found.inputs["sensor"]
    hole = [t for t in np.arange(0.0, 1.0001, 0.001) if not 0.4 < t < 0.6]
    found = read_bag(lambda t: 2e-6, hole, y=lambda t: 1e-6, on_platform=True)
    assert found.unusable == 19 and found.deviation == pytest.approx(1e-6)
    assert not np.any((found.x > 0.41 * SPEED) & (found.x < 0.59 * SPEED))


@pytest.mark.parametrize("gap, unusable", [(0.1, 0), (0.11, 10), (0.12, 11)])
def test_x_is_not_interpolated_over_more_than_a_tenth_of_a_second(read_bag, gap, unusable):
    for begin in (0.0, 0.4, 1.0 - gap):
        stage = np.array([t for t in SECOND if not begin + 0.0001 < t < begin + gap - 0.0001])
        found = read_bag(lambda t: 1e-6, stage)
        assert found.unusable == unusable and found.x == pytest.approx(SPEED * found.time, abs=1e-9)


def test_samples_are_put_in_order_and_readings_before_and_after_the_stages_are_left_out(read_bag):
    found = read_bag(lambda t: 1e-6, SECOND[20:81])
    assert found.x[[0, -1]] == pytest.approx([SPEED * 0.2, SPEED * 0.8])
    assert len(found.x) == 61 and found.unusable == 40 and found.time[[0, -1]] == pytest.approx([0.0, 0.6])
    shuffled = np.random.default_rng(1).permutation(np.concatenate([SECOND, SECOND[:30]]))
    found = read_bag(lambda t: 1e-6 * t, shuffled, shuffled[::-1])
    assert found.time == pytest.approx(SECOND) and found.deviation == pytest.approx(1e-6 * SECOND)


@pytest.mark.parametrize("probe", ["position[displacement]", "point.y"])
@pytest.mark.parametrize("back, said", [(0.5, True), (0.019, False)])
def test_stamps_of_a_clock_that_was_set_back_are_named_and_not_put_in_order_without_a_word(tmp_path, probe, back, said):
    """A stamp that is a little late is not."""
    kind = DISPLACEMENT.layout.type_name if "[" in probe else "geometry_msgs/msg/PointStamped"
    with BagWriter(tmp_path / "bag") as bag:
        bag.add(Topic("/encoder", ENCODER.layout.type_name))
        bag.add(Topic("/probe", kind))
        for t in SECOND:
            stamp = START_NS + round((t - back * (t > 0.7)) * 1e9)
            head = ENCAPSULATION + struct.pack("<II4s4x", *divmod(stamp, 10**9), b"\1\0\0\0")
            own = DISPLACEMENT.layout.pack(stamp, 1e-6) if "[" in probe else head + struct.pack("<3d", 0, 1e-6, 0)
            bag.write("/encoder", ENCODER.layout.pack(stamp, SPEED * t, 0.0, 0.0, 0.0), START_NS, START_NS)
            bag.write("/probe", own, START_NS, START_NS)
    with noting_warnings() as texts:
        series_of_bag(tmp_path / "bag", sensor=Sensor(Field("probe", probe)))
    assert [any(f"'/{topic}' go back by 0.49 s" in one for one in texts) for topic in ("encoder", "probe")] == [
        said
    ] * 2


def test_what_is_not_finite_is_left_out_and_three_samples_must_be_left(read_bag):
    found = read_bag(lambda t: np.nan if t > 0.025 else 1e-6)
    assert (len(found.x), found.unusable) == (3, 98)
    with pytest.raises(SurveyError, match="2 common samples"):
        read_bag(lambda t: np.nan if t > 0.015 else 1e-6)
    with pytest.raises(SurveyError, match="1 common samples"):
        read_bag(lambda t: 1e-6, SECOND[:1])


# One row for each stop, there and back; more rows where the stage stands are a recording.
STOPS = "time_s,x_mm,deviation_um\n0,1,10\n5,2,20\n10,3,30\n15,3,30\n20,2,20\n25,1,10\n"


@pytest.mark.parametrize(
    ("text", "samples"),
    [
        ("x_mm,deviation_um\n1,10\n", 0),
        ("time_s,x_mm,deviation_um,run\n5.0,1,10,1\n5.0,1,10,2\n", 0),
        ("time_s,x_mm,Run 1 [um],Run 2 [um]\n5.0,1,10,10\n", 0),
        (STOPS, 0),
        (STOPS + "30,1,10\n35,1,10\n", 8),
        ("time_s,x_mm,deviation_um\n5.0,1,10\n5.1,2,20\n5.2,3,30\n", 3),
        ("time_s,x_mm,deviation_um,Cycle\n" + "".join(f"{k / 10},{k},1,{k % 2}\n" for k in range(30)), 30),
    ],
    ids=["no time", "named runs", "columns of runs", "stops", "stands at its stops", "moves", "a counter"],
)
def test_a_csv_with_times_is_a_recording_unless_it_names_runs_or_has_one_row_for_each_stop(tmp_path, text, samples):
    path = tmp_path / "series.csv"
    path.write_text(text)
    found = series_of_csv(path)
    assert (found.x.size if found else 0) == samples
    if samples == 3:
        assert found.time == pytest.approx([0.0, 0.1, 0.2]) and found.unusable == 0
        assert found.x == pytest.approx([1e-3, 2e-3, 3e-3]) and found.deviation == pytest.approx([1e-5, 2e-5, 3e-5])


@pytest.mark.parametrize(
    "rows, words",
    [
        ("0,1,1\n1,1,1\n2,1,2\n3,1,1\n", "does not move"),
        ("0,1,1\n1,2,2\n", "2 rows"),
        ("0,1,1\n2,2,2\n1,3,3\n", "line 4: time_s 1 after 2"),
        ("0,1,1\n2,2,2\n2,3,3\n", "line 4: time_s 2 after 2"),
        ("0,1,1\n1,2\n2,3,3\n", "line 3: 2 cells"),
    ],
)
def test_a_recording_as_csv_that_is_none_is_refused(tmp_path, rows, words):
    path = tmp_path / "series.csv"
    path.write_text("time_s,x_mm,deviation_um\n" + rows)
    with pytest.raises(SurveyError, match=words):
        build_from_series(series_of_csv(path), path, CHOICES, {})


def test_a_spike_is_further_out_than_so_many_robust_standard_deviations():
    # The median is 0, the median distance 1 µm: 1.4826 µm is one robust standard deviation.
    base = np.array([-1.0, 1.0] * 20)
    for value, spike in ((8.8, False), (9.0, True), (-8.8, False), (-9.0, True)):
        readings = np.append(base, [0.0, value, -value / 100.0]) * 1e-6
        assert spikes(readings, 6.0).tolist() == [False] * 41 + [spike, False]
        # Where the zero lies does not matter.
        assert spikes(readings + 5e-3, 6.0).tolist() == [False] * 41 + [spike, False]
