"""The page of a map: what its panels and its facts show."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from straightcomp_ros.analysis import map_page
from straightcomp_ros.analysis.map_building import Choices, as_it_is, build
from straightcomp_ros.analysis.metrics import LINES
from straightcomp_ros.straightness.guide_map import MapParameters
from straightcomp_ros.straightness.survey import Run, Survey

X = np.linspace(0.0, 0.4, 41)
CHOICES = Choices(step=10e-3, limit=6.0, level=False)


def run(name, way, shift):
    return Run(name, way, X, 5e-6 * np.sin(10.0 * X) + shift)


def lines(axes):
    return {line.get_label(): np.asarray(line.get_ydata()) for line in axes.get_lines()}


def facts(figure):
    return [text.get_text() for text in figure.texts]


def test_the_panels_show_runs_means_and_bands_and_what_is_left_of_the_mean(drawn):
    runs = (run("1", "forward", 1e-7), run("2", "forward", -1e-7), run("1", "backward", 3e-7))
    built = build(Survey(runs), Path(__file__), CHOICES)
    map_page.plot_map(built, Path("map.png"))
    upper, lower, lowest = drawn[0].axes
    shown = [np.asarray(line.get_ydata()) for line in upper.get_lines()]
    for one in built.straightness.survey.runs:
        assert any(len(um) == 41 and um == pytest.approx(one.deviation * 1e6) for um in shown)
    assert lines(upper)["forward, mean of 2"] == pytest.approx((built.straightness.report.mean - 0.15e-6) * 1e6)
    # Forward lies 0.15 µm below the mean of both directions, backward as much above.
    assert lines(lower)["forward, mean"] == pytest.approx(-0.15)
    assert lines(lower)["backward, mean"] == pytest.approx(0.15)
    # A single run has no standard deviation: the band is that of the two forward ones, s = 0.1 √2 µm.
    (band,) = lower.collections
    low, high = band.get_paths()[0].get_extents().intervaly
    assert (low, high) == pytest.approx((-0.15 - 0.2 * np.sqrt(2.0), -0.15 + 0.2 * np.sqrt(2.0)))
    for line in (line for axes in drawn[0].axes for line in axes.get_lines() if len(line.get_xdata()) > 2):
        assert (line.get_xdata()[0], line.get_xdata()[-1]) == pytest.approx((0.0, 400.0))
    # A legend hides no curve and no band, and takes no third of a panel.
    for axes in drawn[0].axes:
        (bottom, top), highest = axes.get_ylim(), axes.dataLim.y1
        assert axes.get_legend() and 0.2 < (top - highest) / (top - bottom) < 0.3
    # Without noise the map goes through every mean.
    assert lines(lowest)["mean of the runs"] == pytest.approx(0.0, abs=1e-9)


def test_the_facts_of_a_page_stand_apart_from_each_other_and_from_the_panels_within_the_sheet(drawn):
    built = build(Survey((run("1", "forward", 1e-7), run("1", "backward", -1e-7))), Path(__file__), CHOICES)
    map_page.plot_map(
        replace(built, provenance={**built.provenance, "instrument": 40 * "laser "}), Path("map.png"), "a"
    )
    (figure,) = drawn
    renderer, sheet = FigureCanvasAgg(figure).get_renderer(), figure.bbox
    texts = [(text.get_text(), text.get_window_extent(renderer)) for text in figure.texts if text.get_text()]
    for text, box in texts:
        assert 0.0 < box.x0 < box.x1 < sheet.width and 0.0 < box.y0 < box.y1 < sheet.height, text
    # Letters may reach into the next line by a pixel or two.
    for (text, box), (other, its) in itertools.combinations(texts, 2):
        apart = box.x1 <= its.x0 or its.x1 <= box.x0 or box.y1 <= its.y0 + 3 or its.y1 <= box.y0 + 3
        assert apart, (text, other)
    panels = [axes.get_window_extent(renderer) for axes in figure.axes]
    top, bottom = max(one.y1 for one in panels), min(one.y0 for one in panels)
    assert all(box.y0 > top or box.y1 < bottom for _, box in texts)
    # A line to write on begins behind each name, and ends before the next.
    names = [box for text, box in texts if text in ("Measured by", "Date", "Signature")]
    lines = [line.get_window_extent(renderer) for line in figure.artists]
    for name, line, following in zip(names, lines, [*names[1:], sheet], strict=True):
        assert name.x1 < line.x0 < line.x1 < following.x0 or (following is sheet and line.x1 < sheet.width)
        assert name.y0 - 5 < line.y0 < name.y1 and line.width > 0.12 * sheet.width


def test_the_bands_of_a_map_are_those_of_its_noise_over_the_whole_survey_and_its_straightness_that_of_the_figures(
    drawn,
):
    random = np.random.default_rng(0)
    runs = (run(str(k), "forward", random.normal(0.0, 3e-7, X.size)) for k in range(6))
    built = build(Survey(tuple(runs)), Path(__file__), CHOICES)
    map_page.plot_map(built, Path("map.png"))
    figures = built.figures()
    for line in LINES:
        stated = f"{figures[f'straightness_{line}_um']:.3f} µm ± "
        assert any(text.startswith(stated) and "ISO 230-1" in text for text in facts(drawn[0]))
    band = built.straightness.noise.band(X) * 1e6
    for shown, factor in zip(drawn[0].axes[2].collections, (1.96, 1.0), strict=True):
        extent = shown.get_paths()[0].get_extents()
        assert (*extent.intervalx, *extent.intervaly) == pytest.approx(
            (0.0, 400.0, -factor * band.max(), factor * band.max()), rel=1e-3, abs=1e-9
        )
    (points,) = drawn[0].axes[2].get_lines()
    left = built.straightness.report.mean - built.straightness.deviations(X)
    assert points.get_ydata() == pytest.approx(left * 1e6) and points.get_xdata() == pytest.approx(X * 1e3)


def test_rejected_runs_and_points_are_drawn_where_they_were_measured_and_named_by_every_page(drawn, tmp_path):
    random = np.random.default_rng(0)
    runs = [run(str(k), "forward", random.normal(0.0, 3e-8, X.size)) for k in range(6)]
    spike = np.where(np.arange(X.size) == 20, 2e-6, 0.0)
    runs[1] = replace(runs[1], deviation=runs[1].deviation + spike)
    runs[4] = replace(runs[4], deviation=runs[4].deviation + np.where(X > 0.2, 3e-6, 0.0))
    built = build(Survey(tuple(runs)), Path(__file__), CHOICES)
    assert (built.rejected_runs, built.rejected_points) == (["4 forward"], [("1 forward", X[20])])
    map_page.plot_map(built, Path("map.png"))
    lower = lines(drawn[0].axes[1])
    assert lower["rejected point"] == pytest.approx([2.0], abs=0.1)
    assert lower["rejected run"][-5:] == pytest.approx(3.0, abs=0.1)
    # The others' panel is at most twice as high, and a half for its legend.
    others = [line.get_ydata() for line in drawn[0].axes[1].get_lines() if line.get_label() != "rejected run"]
    assert np.ptp(drawn[0].axes[1].get_ylim()) < 2.0 * 1.1 * 1.3 * np.ptp(np.concatenate(others))
    built.write(tmp_path / "map.csv")
    map_page.plot_map(as_it_is(MapParameters(file=str(tmp_path / "map.csv"))), Path("map.png"))
    for page in map(facts, drawn):
        assert {"5 forward, 0 backward", "4 forward", "41, spacing 10 mm; rejected: 1"} <= {*page}
