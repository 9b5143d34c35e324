"""Figures of one stroke, limits, and what the pictures show: numbers whose right value is known."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from scipy.ndimage import maximum_filter1d

from straightcomp_ros.analysis import html_report as report
from straightcomp_ros.analysis import pictures as plot
from straightcomp_ros.analysis.assessment import Interval
from straightcomp_ros.analysis.error_detail import SLIP, StickSlip, stick_slips
from straightcomp_ros.analysis.html_page import blocks, line_figure, worded
from straightcomp_ros.analysis.metrics import evaluate, stroke_figures
from straightcomp_ros.analysis.record import MetricsError, StrokeRecord, motion_of


def one_way(deviation, y=0.0, r=0.0, truth=None):
    """A stroke at 0.2 m/s over 0.4 m, sampled each millisecond."""
    time = np.arange(2001) * 1e-3
    x = 0.2 * time
    true = {} if truth is None else {"true_x": x, "true_y": truth + 0.0 * x, "guide": deviation(x)}
    record = StrokeRecord(time, x, y + 0.0 * x, r + 0.0 * x, 0.0 * x, "law", **true)
    return record, record.motion.strokes[0]


def guide_map(deviation):
    return SimpleNamespace(directed=False, deviations=deviation, evaluate=lambda x: (-deviation(x), 0.0 * x, 0.0 * x))


def bow(x):
    return 8e-6 * x * (0.4 - x) / 0.04


def test_the_figures_of_a_stroke_over_a_bow_are_its_height_before_and_after_and_those_of_the_truth_where_it_is_known():
    x = 0.2 * np.arange(2001) * 1e-3
    record, stroke = one_way(bow, y=-0.5 * bow(x), r=-0.5 * bow(x) + 1e-6 * np.sin(200.0 * x))
    figures = stroke_figures(record.part(stroke.samples), guide_map(bow), stroke.direction)
    assert figures.direction == "forward" and figures.true_pp is figures.true_rms is None
    assert (figures.travel, figures.start) == pytest.approx((0.4, stroke.start * 1e-3), abs=1e-3)
    assert figures.duration == pytest.approx(figures.travel / 0.2)
    assert (figures.before_end_points, figures.before_least_squares) == pytest.approx((8e-6, 8e-6), rel=1e-2)
    assert (figures.after_end_points, figures.after_least_squares) == pytest.approx((4e-6, 4e-6), rel=1e-2)
    assert (figures.before_minimum_zone, figures.after_minimum_zone) == pytest.approx((8e-6, 4e-6), rel=1e-2)
    assert figures.encoder_pp == pytest.approx(2e-6, rel=1e-2)
    assert figures.encoder_rms == pytest.approx(1e-6 / math.sqrt(2.0), rel=0.05)
    record, stroke = one_way(bow, truth=-bow(x))
    straight = guide_map(lambda x: 0.0 * x)
    figures = stroke_figures(record.part(stroke.samples), straight, stroke.direction)
    # r is zero, and the platform moves by the bow: the workpiece is straight, the error as large as the bow.
    assert (figures.before_end_points, figures.true_pp) == pytest.approx((8e-6, 8e-6), rel=1e-2)
    assert figures.after_end_points == pytest.approx(0.0, abs=1e-12)
    assert figures.true_rms == pytest.approx(8e-6 * math.sqrt(8.0 / 15.0), rel=1e-2)


@pytest.mark.parametrize("held", [1, 2, 3])
@pytest.mark.parametrize("within", [1, 2, 3])
def test_a_jog_within_a_few_samples_is_evaluated_or_is_no_stroke(assessed, within, held):
    # 0.1 mm at 500 Hz, after a stroke, of an encoder that gives each reading so many times.
    time, readings = np.arange(1500) * 2e-3, (np.arange(1500) - 1000) // held
    x = 0.1 * np.clip(time - 0.2, 0.0, 1.0) + 1e-4 * np.clip(readings / (within + 1), 0.0, 1.0)
    record = StrokeRecord(time, x, 0.0 * x, 0.0 * x, 0.0 * x, "law")
    assert len(assessed(record).strokes) == (2 if within > 1 else 1)


@pytest.mark.parametrize(
    ("way", "speed"), [(1e-3, 1e-4), (1e-3, 5e-4), (-1e-3, 9e-4), (0.06e-3, 1e-4), (-0.06e-3, 6e-3), (1.2e-3, 6e-3)]
)
def test_a_stage_that_creeps_or_is_shifted_by_more_than_half_a_jog_makes_strokes(way, speed):
    time, lasts = np.arange(30_000) * 1e-3, abs(way) / speed
    there, back = (np.clip((time - begin) / lasts, 0.0, 1.0) for begin in (2.0, 16.0))
    x = 1e-7 * np.round(way * (there - back) / 1e-7)
    strokes = motion_of(time, x).strokes
    assert [one.direction for one in strokes] == ["forward", "backward"][:: 1 if way > 0.0 else -1]
    for one, begin in zip(strokes, (2.0, 16.0), strict=True):
        assert (time[one.start], time[one.stop - 1]) == pytest.approx((begin, begin + lasts), abs=0.03)
    # A shorter shift, a platform on its way to rest, or a stage that trembles, makes none.
    for still in (0.04e-3 / way * x, 1e-5 * np.sin(2.0 * np.pi * time)):
        with pytest.raises(MetricsError, match="does not move"):
            motion_of(time, still)


def test_a_stick_has_the_place_and_time_at_which_it_began_either_way():
    time = np.arange(3000) * 1e-3
    for way in (1.0, -1.0):
        r = way * 10e-6 * time
        # It stands from 1.0 to 1.5 s while the reference runs 5 µm ahead, then jumps after it.
        y = np.where((time > 1.0) & (time <= 1.5), r[1000], r)
        (event,) = stick_slips(time, 0.1 * time, y, r)
        assert event.time == pytest.approx(1.0, abs=0.02) and event.x == pytest.approx(0.1, abs=0.002)
        assert event.duration == pytest.approx(0.5, abs=0.02)
        assert event.slip == pytest.approx(5e-6, rel=0.1)
        # So has one that trembles by less than what counts as standing.
        trembling = y + 5e-8 * np.cos(np.pi * np.arange(3000))
        assert [one.time for one in stick_slips(time, 0.1 * time, trembling, r)] == pytest.approx([1.0], abs=0.02)
        # One that creeps after it is none; and one that jumps the other way neither.
        creeping = np.interp(time, [0.0, 1.0, 1.5, 2.5, 3.0], [0.0, r[1000], r[1000], r[2500], r[-1]])
        assert stick_slips(time, 0.1 * time, creeping, r) == []
        away = np.where(time > 1.5, r[1000] - 5e-6 * way, y)
        assert [event for event in stick_slips(time, 0.1 * time, away, r) if event.time < 1.1] == []
        # Nor one that lags, seen in counts, fine or coarse: of these each is as long as a stick of a fine encoder.
        for count in (1e-7, 1e-6):
            lagging = np.round((r - 1.5e-6 * way) / count) * count
            assert stick_slips(time, 0.1 * time, lagging, r, count) == []
        (coarse,) = stick_slips(time, 0.1 * time, np.round(y / 1e-6) * 1e-6, r, 1e-6)
        assert (coarse.time, coarse.slip) == pytest.approx((1.0, 5e-6), rel=0.25)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_slip_makes_good_at_least_its_part_of_the_stick_beyond_the_reference_s_own_motion(way):
    step, samples = way * 1e-7, np.arange(1000)
    r, time = step * samples, 1e-3 * samples
    ahead = step * 99  # from the first sample of the stick to the last
    for beyond, events in ((0.5, 1), (-0.5, 0)):
        jump = SLIP * ahead + (1.0 + beyond) * step
        y = np.where(samples < 500, r, r[500] + np.where(samples < 600, 0.0, jump))
        found = stick_slips(time, time, y, r)
        assert len([event for event in found if event.time == pytest.approx(0.5)]) == events
    # A stick at the end of the record has no slip.
    assert stick_slips(time[:600], time[:600], y[:600], r[:600]) == []


def lines(axes):
    return [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in axes.get_lines()]


@pytest.mark.parametrize("truth", [True, False])
def test_the_picture_of_a_run_shows_the_record_in_its_units(make_record, cosine_map, drawn, truth):
    record = make_record(0.4e-6, truth=truth)
    record = replace(record, current=0.02 * np.sin(record.time))
    motion, metrics = record.motion, evaluate(record, cosine_map)
    plot.plot_run(record, cosine_map, metrics, Path("run.png"), "title")
    both, after, error, current = drawn[0].axes
    window, moving = motion.window, motion.samples()
    ((seconds, milliamperes),) = lines(current)
    assert seconds == pytest.approx(record.time[window]) and milliamperes == pytest.approx(record.current[window] * 1e3)
    (_, shown), *of_truth = lines(error)
    assert shown == pytest.approx((record.r - record.y)[window] * 1e6)
    assert [values for _, values in of_truth] == ([pytest.approx(0.4, abs=1e-6)] if truth else [])
    (x_mm, before), (_, compensated) = lines(both)
    assert x_mm == pytest.approx((record.true_x if truth else record.x)[moving] * 1e3)
    assert np.ptp(before) == pytest.approx(metrics.uncompensated_pp * 1e6)
    assert np.ptp(compensated) == pytest.approx(metrics.residual_pp * 1e6)
    # A legend hides no curve, and takes no third of a panel.
    for axes in drawn[0].axes:
        (bottom, top), highest = axes.get_ylim(), max(np.max(values) for _, values in lines(axes))
        assert 0.2 < (top - highest) / (top - bottom) < 0.3
    for (x, values), (centres, means) in zip(lines(after)[::2], lines(after)[1::2], strict=True):
        assert x.min() <= centres.min() and centres.max() <= x.max()
        assert values.min() <= means.min() and means.max() <= values.max()
    for patch, stroke in zip(error.patches, motion.strokes, strict=True):
        span = patch.get_extents().transformed(error.transData.inverted())
        assert (span.x0, span.x1) == pytest.approx((record.time[stroke.start], record.time[stroke.stop - 1]))


def test_the_curves_of_the_report_are_thin_and_in_its_units_and_another_run_begins_where_this_one_does(
    make_record, motion_profile, assessed
):
    record = make_record(1e-6 * np.sin(2 * np.pi * 50 * motion_profile[0]), quantum=1e-9)
    found, other = assessed(record), assessed(replace(record, time=record.time + 100.0), "b")
    before, forward, backward = report._straightness(found).data
    assert max(forward.x) == pytest.approx(1760.0, abs=1.0) and len(report._straightness(found, before=False).data) == 2
    assert np.ptp(before.y) == pytest.approx(found.metrics.uncompensated_pp * 1e6)
    assert np.ptp(np.concatenate([forward.y, backward.y])) == pytest.approx(found.metrics.residual_pp * 1e6)
    encoder, true, theirs = report._error(found, other).data
    # However long the record, a page carries some thousand points, with the extremes.
    assert len(encoder.x) <= 10_000 < len(record.time) and (np.diff(encoder.x) > 0.0).all()
    assert len(report._extremes(np.zeros(100))) == 100
    assert [encoder.x[0], encoder.x[-1]] == pytest.approx(record.moving.time[[0, -1]].tolist(), abs=0.01)
    assert np.ptp(encoder.y) == pytest.approx(found.metrics.encoder_pp * 1e6)
    assert np.ptp(true.y) == pytest.approx(2.0, abs=0.01)
    assert min(theirs.x) == pytest.approx(min(true.x), abs=0.05) and theirs.name == "b"
    spectrum, of_other = report._spectrum(found, other).data
    assert (spectrum.name, of_other.name) == ("this run", "b")
    current = report._current(found).data[0]
    assert max(current.y) == pytest.approx(1.0) and current.x[-1] == pytest.approx(record.moving.time[-1], abs=0.01)
    peak = int(np.argmax(spectrum.y))
    assert spectrum.x[peak] == pytest.approx(50.0, abs=1.0)
    assert spectrum.y[peak] == pytest.approx(math.sqrt(0.5 / 1.5), rel=0.05)


def test_of_a_long_curve_each_extreme_is_kept_within_a_few_samples_and_a_short_one_is_kept_whole():
    for count in (6000, 6001, 9001, 25_000, 100_003):
        values, near = np.random.default_rng(count).normal(size=count), 2 * -(-count // 3000) - 1
        kept = report._extremes(values)
        assert (np.diff(kept) > 0).all() and kept.size <= 9000 and (kept.size == count or count > 6000)
        for curve in (values, -values):
            left = np.full(count, -np.inf)
            left[kept] = curve[kept]
            assert (maximum_filter1d(left, near, mode="nearest") >= curve).all()


def test_the_head_and_the_strokes_of_a_report_say_which_machine_when_and_how_much(make_record, assessed):
    record = make_record(0.3e-6)
    serial = {"driver": {"stage.serial": "A7", "stage.name": "two"}}
    for simulated, begin_ns, parameters, said in (
        (
            "simulated",
            1_700_000_000_000_000_000,
            serial,
            "stage “two”, serial number A7, simulated machine; began 2023-11-14 22:13",
        ),
        ("can", 1_000_000_000, serial, "stage “two”, serial number A7, real machine; report"),
        ("", 0, {}, "stage “unknown”, machine not recorded; report"),
    ):
        known = {name: {**of, "hardware": simulated} for name, of in parameters.items()}
        every = np.round(record.time * 1e9).astype(np.int64) + begin_ns
        found = assessed(record, stamps=every, parameters=known, begin_ns=begin_ns)
        assert said in report._whose(found)
    errors, straightness = str(report._strokes(found)).split("</table>")[:2]
    assert errors.count("<tr>") == straightness.count("<tr>") == 3
    assert "before" in straightness and "before" not in errors and "RMS" in errors and "RMS" not in straightness


def test_intervals_are_marked_where_they_are_and_named_once():
    figure = line_figure("x", "y")
    report._mark(figure, [Interval(0.1 * k, 0.1 * k + 0.05, 3) for k in range(3)], "lost", "#000000")
    shapes = figure.layout.shapes
    assert len(shapes) == 3 and [one.text for one in figure.layout.annotations] == ["lost"]
    assert [(one.x0, one.x1) for one in shapes] == [pytest.approx((0.1 * k, 0.1 * k + 0.05)) for k in range(3)]
    assert figure.layout.annotations[0].x == pytest.approx(0.0, abs=0.06)


@pytest.mark.parametrize("spread", [0.0, 0.4e-6, 100e-6])
def test_a_histogram_of_the_timing_counts_every_sample_in_bars_of_a_microsecond_or_more(make_record, assessed, spread):
    latency, lateness = 200e-6 + spread * np.linspace(0.0, 1.0, 500), 200e-6 + 0.5 * spread * np.linspace(0.0, 1.0, 100)
    timing = report._timing(assessed(make_record(), latency=latency, lateness=lateness))
    for bars, values in zip(timing.data, (latency, lateness), strict=True):
        assert sum(bars.y) == values.size and bars.width == pytest.approx(max(1.0, spread * 1e6 / 200.0))
        assert np.average(bars.x, weights=bars.y) == pytest.approx(values.mean() * 1e6, abs=0.5 * bars.width)
    low, high = 10.0 ** np.array(timing.layout.yaxis.range)
    assert low < 1.0 and max(timing.data[0].y) < high <= 2.0 * max(timing.data[0].y) + 1.0
    assert report._timing(assessed(make_record(), latency=np.empty(0), lateness=np.empty(0))) is None


def test_events_are_in_the_report_in_the_units_of_their_columns_and_forty_at_most():
    def events(**found):
        none = {"gaps": [], "saturated": [], "amplifier_off": [], "stick_slips": []}
        return dict(report._events(SimpleNamespace(**none | found)))

    slips = [StickSlip(1.5, 0.2, 0.25, 7e-6)] * 41
    text = events(stick_slips=slips)["Stick-slip: 41"]
    assert "and 1 more" in text and text.count("<tr>") == 41
    assert all(words in text for words in ("x / mm", ">200<", "slip / µm", ">7<"))
    assert "more" not in events(stick_slips=slips[:40])["Stick-slip: 40"] and not any(events().values())
    assert "Amplifier off while the stage moved: 1" in events(amplifier_off=[Interval(0.5, 0.75, 500)])


def test_a_table_shows_numbers_to_four_digits_texts_as_they_are_and_a_dash_for_nothing():
    assert blocks.table([]) == ""
    values = (None, math.nan, math.inf, 3, 0.123456, "a<b", True, False)
    text = blocks.table(worded({"slip_um": value} for value in values))
    cells = re.findall(r"<td[^>]*>(.*?)</td>", text)
    assert cells == ["–", "–", "inf", "3", "0.1235", "a&lt;b", "passed", "FAILED"]
    assert text.count("<tr>") == len(values) + 1 and "<th>slip / µm<" in str(text).replace(' class="n"', "")


def test_a_long_title_is_drawn_within_the_picture(make_record, cosine_map, drawn):
    record = make_record(0.4e-6)
    plot.plot_run(record, cosine_map, evaluate(record, cosine_map), Path("run.png"), "an incident: its cause " * 20)
    FigureCanvasAgg(drawn[0]).draw()
    title = drawn[0]._suptitle.get_window_extent()
    assert title.x0 >= 0.0 and title.x1 <= drawn[0].bbox.width
    assert title.y0 >= max(axes.get_tightbbox().y1 for axes in drawn[0].axes)


def test_the_line_of_means_follows_a_short_stroke(make_record, cosine_map, drawn):
    record = make_record(0.4e-6, truth=False)
    record = replace(record, x=0.03 * record.x)
    plot.plot_run(record, cosine_map, evaluate(record, cosine_map), Path("run.png"), "title")
    assert {len(x) for x, _ in lines(drawn[0].axes[1])[1::2]} <= {50, 51}
