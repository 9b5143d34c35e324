"""From changed figures to a cause and a remedy; the file of advice; what a person would have been alarmed of."""

import json
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone

import numpy as np
import pyarrow
import pytest

from straightcomp_ros.fleet.maintenance.advice import advice_json, advice_of
from straightcomp_ros.fleet.maintenance.day_levels import day_levels
from straightcomp_ros.fleet.maintenance.stage_report import evidence, faults_over_time, stage_report
from straightcomp_ros.parameters.output_files import json_text
from straightcomp_ros.stage.due_maintenance import read_advice
from trials.wear import BAGS_A_DAY, SOUND, WEARS, alarms_of, judged, months

DAYS, BEGIN = 120, 60
SINCE = np.maximum(np.arange(DAYS) - BEGIN, 0.0)
PLACES = np.arange(DAYS)
STEP = (PLACES >= BEGIN).astype(float)


@pytest.mark.parametrize(
    ("figure", "factors", "cause", "words"),
    [
        ("friction_A", 1.0 + 0.005 * SINCE, "friction_up", "regrease"),
        ("friction_A", 1.0 - 0.005 * SINCE, "friction_down", "greased"),
        ("stiffness_A_per_m", 1.0 + 0.003 * SINCE, "stiffness", "encoder of y"),
        ("amplifier_bandwidth_Hz", 1.0 - 0.005 * SINCE, "amplifier", "amplifier and its supply"),
        ("latency_p50_us", 1.0 + 0.3 * STEP, "host", "straightcomp doctor"),
        ("encoder_rms_um", 1.0 + 0.005 * SINCE, "unknown", "evaluate"),
    ],
)
def test_each_figure_has_its_cause_and_remedy(make_levels, figure, factors, cause, words):
    (found,) = advice_of(make_levels(**{figure: factors}))
    assert found.cause == cause and words in found.remedy and found.due
    assert found.since >= date(2026, 2, 20) and found.changes[0].figure == figure


def test_scatter_and_a_guide_that_bows_are_no_change(make_levels):
    """Nor is a straight edge that was put down anew, whose error is a slope and a bow too."""
    x = np.linspace(-1.0, 1.0, 100)
    for levels in (make_levels(), make_levels(guide=np.outer(STEP, 3.0 * x + 0.5 * x * x))):
        assert advice_of(levels) == alarms_of(levels) == []


def bump(low, high):
    middles = (np.arange(100) + 0.5) * 10.0
    return ((middles > low) & (middles < high)).astype(float)


@pytest.mark.parametrize("change, cause, word", [(0.005 * SINCE, "guide", "survey"), (0.5 * STEP, "bolt", "bolts")])
def test_a_guide_that_moved_has_a_place_and_if_it_moved_at_once_its_bolts_are_loose(make_levels, change, cause, word):
    (found,) = advice_of(make_levels(guide=np.outer(change, bump(300, 420))))
    assert found.cause == cause and word in found.remedy
    assert abs(found.place.first - 300) <= 20 and abs(found.place.last - 420) <= 20
    assert f"x = {found.place.first} to {found.place.last} mm" in found.text
    assert cause == "guide" or found.since == date(2026, 3, 2)


@pytest.mark.parametrize(
    ("moves", "days", "places"),
    [
        ({300: STEP}, BEGIN + 1, [300]),
        ({300: STEP}, BEGIN + 3, [300]),
        ({300: (PLACES >= 40) & (PLACES < 60)}, DAYS, [300]),
        ({300: (PLACES >= 40) & (PLACES < 42)}, DAYS, [300]),
        ({300: (PLACES >= 40) & (PLACES < 60), 700: PLACES >= 100}, DAYS, [700, 300]),
    ],
)
def test_the_place_is_that_of_the_last_days_of_the_move_however_new_or_long_ago_it_is(make_levels, moves, days, places):
    """In the text, in the file of advice, and as the stretch and the last curve of the evidence."""
    whole = make_levels(guide=sum(np.outer(0.5 * when, bump(at, at + 120)) for at, when in moves.items()))
    levels = replace(
        whole,
        day=whole.day[:days],
        columns={name: values[:days] for name, values in whole.columns.items()},
        profiles={name: values[:days] for name, values in whole.profiles.items()},
        settings={name: values[:days] for name, values in whole.settings.items()},
    )
    found = advice_of(levels)
    assert [one.cause for one in found] == ["bolt"] * len(places)
    for one, at in zip(found, places, strict=True):
        assert np.abs(np.subtract(one.place, (at, at + 120))).max() <= 20
        assert f"x = {one.place.first} to {one.place.last} mm by 0.5" in one.text
        x, newest = evidence(levels, one).data[-1].x, np.abs(evidence(levels, one).data[-1].y)
        assert at < x[newest.argmax()] < at + 120 and newest.max() > 0.25


def of_strokes(make_levels, guide, maps):
    """Months whose days have as many strokes, forward and backward in turn, with these profiles (k n, m) and maps."""
    sound, each = make_levels(), len(guide) // DAYS
    noise = 0.005 * np.random.default_rng(4).standard_normal(guide.shape)
    columns = {
        **{name: np.repeat(values, each) for name, values in sound.columns.items()},
        "start": np.repeat(sound.day, each).astype("datetime64[D]").astype("datetime64[us]"),
        "direction": ["forward", "backward"] * (len(guide) // 2),
        "verdict": ["in_order"] * len(guide),
        "bins_from_mm": np.zeros(len(guide), int),
        "guide_change_um": list(guide + noise),
        "error_bins_um": list(np.zeros(guide.shape)),
        "map_checksum": maps,
    }
    same = dict.fromkeys(("software_version", "parameters_checksum"), ["1"] * len(guide))
    return day_levels(pyarrow.table(columns | same))


def test_strokes_with_another_map_are_no_part_of_the_guide_s_history(make_levels):
    # From the second stroke of that day on.
    renewed = 2 * BEGIN + 1
    guide = np.outer(0.5 * (np.arange(2 * DAYS) >= renewed), bump(600, 700))
    maps = [*["a"] * renewed, *["c"] * (2 * DAYS - renewed)]
    levels = of_strokes(make_levels, guide, maps)
    profiles = levels.profiles["guide_change_um"]
    assert not np.isfinite(profiles[:BEGIN]).any() and np.isfinite(profiles[BEGIN:]).all()
    assert profiles[BEGIN].max() == pytest.approx(0.5, abs=0.05), "a mean of both maps"
    assert advice_of(levels) == []


def test_a_stroke_without_map_and_sensor_leaves_the_guide_s_history_as_it_is(make_levels):
    guide = np.outer(0.5 * np.repeat(STEP, 2), bump(600, 700))
    guide[-3] = np.nan
    maps = ["a"] * (2 * DAYS)
    maps[-3] = ""
    (found,) = advice_of(of_strokes(make_levels, guide, maps))
    assert found.cause == "bolt"


@pytest.mark.parametrize("loose", [0.0, 0.5])
def test_jogs_say_nothing_of_the_guide_and_hide_nothing(make_levels, loose):
    """Beside a straight edge that is not parallel a jog, whose mean is taken out over its own x, looks like a step."""
    x = (np.arange(100) + 0.5) * 0.01
    guide = 10.0 * (x - x.mean()) + loose * np.outer(np.repeat(STEP, 6), bump(600, 700))
    jogs = (np.arange(6 * DAYS) % 6 >= 2) & (np.repeat(STEP, 6) > 0.0)
    guide[jogs] = np.where(bump(300, 420) > 0.0, 10.0 * (x - 0.36), np.nan)
    found = advice_of(of_strokes(make_levels, guide, ["a"] * (6 * DAYS)))
    assert [(one.cause, abs(one.place.first - 600) <= 20) for one in found] == [("bolt", True)] * (loose > 0.0)


@pytest.mark.parametrize("loose", [0.0, 0.5])
@pytest.mark.parametrize("longer", [[2 * 40], [2 * 70, 2 * 70 + 1, 2 * 110]])
def test_strokes_that_went_farther_once_hide_nothing_of_the_guide(make_levels, longer, loose):
    x = (np.arange(100) + 0.5) * 0.01
    guide = 10.0 * (x - x.mean()) + loose * np.outer(np.repeat(STEP, 2), bump(300, 420))
    daily = np.ones(2 * DAYS, bool)
    daily[longer] = False
    guide[np.ix_(daily, x > 0.7)] = np.nan
    guide -= np.nanmean(guide, axis=1, keepdims=True)
    levels = of_strokes(make_levels, guide, ["a"] * (2 * DAYS))
    assert levels.measured.size == DAYS
    found = advice_of(levels)
    assert [(one.cause, abs(one.place.first - 300) <= 20) for one in found] == [("bolt", True)] * (loose > 0.0)


def test_what_changed_with_an_update_names_it(make_levels):
    software = [*["1.1"] * BEGIN, *["1.2"] * (DAYS - BEGIN)]
    (found,) = advice_of(make_levels(latency_p50_us=1.0 + 0.3 * STEP, software=software))
    assert "software changed from 1.1 to 1.2 on 2026-03-02" in found.text and "compare" in found.remedy


def test_two_causes_are_two_matters_and_what_follows_from_a_cause_is_none(make_levels):
    more, latency = 1.0 + 0.005 * SINCE, 1.0 + 0.3 * STEP
    (found,) = advice_of(
        make_levels(friction_A=more, coil_work_A2s=more**2, encoder_rms_um=more, stiffness_A_per_m=more**0.3)
    )
    assert found.cause == "friction_up" and len(found.changes) == 4
    both = advice_of(make_levels(friction_A=more, latency_p50_us=latency))
    assert {one.cause for one in both} == {"friction_up", "host"}


def test_advice_lapses_when_the_figure_is_back_and_hides_nothing_that_lasts(make_levels):
    """Lost samples of a week long ago are no explanation of a latency of today, and no advice any more."""
    levels = make_levels(latency_p50_us=1.0 + 0.3 * (PLACES >= 80), encoder_rms_um=1.0 + 0.3 * (PLACES >= 100))
    levels.columns["lost_samples"][40:50] = 500.0
    due, lapsed = advice_of(levels)
    assert len(advice_json("gantry", date(2026, 5, 1), [due, lapsed])["advice"]) == 1
    assert due.due and due.changes[0].figure == "latency_p50_us"
    assert [change.figure for change in due.changes[1:]] == ["encoder_rms_um"]
    assert not lapsed.due and [change.figure for change in lapsed.changes] == ["lost_samples"]


@pytest.mark.parametrize("wear", WEARS, ids=lambda wear: wear.name)
def test_simulated_wear_is_found_with_its_cause(pool, wear):
    strokes = months(pool, wear, 60, 260, 5, bags=BAGS_A_DAY // 4)
    found = [one for one in advice_of(day_levels(strokes)) if one.cause == wear.cause]
    assert found and found[0].found >= date(2026, 3, 2)


@pytest.mark.parametrize("interrupted", [[161], [160, 161], range(320)])
def test_a_stroke_that_was_interrupted_is_part_of_no_level(pool, interrupted):
    strokes = months(pool, SOUND, 60, 160, 5, bags=1)
    for name, value in {"verdict": "interrupted", "lost_samples": 5000.0, "encoder_rms_um": 3.0}.items():
        column = strokes[name].to_pylist()
        for n in interrupted:
            column[n] = value
        strokes = strokes.set_column(strokes.schema.get_field_index(name), name, [column])
    levels = day_levels(strokes)
    assert advice_of(levels) == [] and len(levels.day) == 160
    assert stage_report("gantry", strokes)


AGAIN = ((PLACES >= 40) & (PLACES < 55)) | ((PLACES >= 80) & (PLACES < 95))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("factors", "alarms"),
    [
        ({"friction_A": 1.0 + 0.3 * AGAIN}, [("friction_up", 1), ("friction_up", 2)]),
        # First the error alone is worse, then the friction that explains it is seen.
        (
            {"encoder_rms_um": 1.0 + 0.5 * (PLACES >= 40), "friction_A": 1.0 + 0.5 * (PLACES >= 60)},
            [("unknown", 1), ("friction_up", 1)],
        ),
        # Stiffness first follows friction, then is a matter of its own, while no figure's alarm begins or ends.
        (
            {
                "friction_A": 1.0 + 0.5 * (PLACES >= 40),
                "stiffness_A_per_m": 1.0 + 0.1 * (PLACES >= 40) + 0.4 * (PLACES >= 80),
            },
            [("friction_up", 1), ("stiffness", 2)],
        ),
    ],
)
def test_an_alarm_that_comes_again_or_with_another_cause_counts_again(make_levels, factors, alarms):
    assert [(cause, day // 40) for cause, day in alarms_of(make_levels(**factors))] == alarms


def test_the_alarm_with_the_right_cause_counts_from_the_wear_s_beginning():
    alarms = [("friction_up", 50), ("host", 130), ("friction_up", 170), ("friction_up", 300)]
    assert judged(alarms, "friction_up") == (50, 2)


def test_what_is_written_is_read(make_levels, tmp_path):
    advice, path = advice_of(make_levels(friction_A=1.0 + 0.005 * SINCE)), tmp_path / "stage.json"
    path.write_text(json_text(advice_json("gantry", date(2026, 5, 1), advice)))
    due = read_advice(path)
    assert due.startswith("as of 2026-05-01: friction rose by") and "regrease" in due
    written = json.loads(path.read_text("utf-8"))
    assert written["stage"] == "gantry"
    entry = written["advice"][0]
    assert entry["figures"]["friction_A"]["after"] > entry["figures"]["friction_A"]["before"] > 0.0


@pytest.mark.nightly
def test_sound_stages_raise_less_than_one_alarm_a_year(pool):
    years = [day_levels(months(pool, SOUND, 0, 365, 900 + seed, bags=4)) for seed in range(5)]
    assert sum(len(alarms_of(year)) for year in years) <= 5


def test_each_fault_has_a_mark_in_the_line_of_its_kind():
    starts = [datetime(2026, 1, 1, tzinfo=timezone.utc) + timedelta(days=day) for day in range(30)]
    faults = [[] for _ in starts]
    assert faults_over_time(starts, faults) is None
    faults[3], faults[7], faults[20] = ["x_jump"], ["x_jump", "y_frozen"], ["x_jump"]
    figure = faults_over_time(starts, faults)
    # The most frequent one is drawn last, on top; quiet days belong to the picture.
    expected = [("y_frozen: 1", [7]), ("x_jump: 3", [3, 7, 20])]
    marks = [(line.y[0], list(line.x)) for line in figure.data]
    assert marks == [(name, [starts[place].isoformat() for place in places]) for name, places in expected]
    assert figure.layout.xaxis.range == (starts[0].isoformat(), starts[-1].isoformat())
