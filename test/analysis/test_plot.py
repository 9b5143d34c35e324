"""The picture of a run: it is made, it shows every curve whole, it leaves no global state."""

import dataclasses
import sys
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.pictures import plot_run
from straightcomp_ros.analysis.record import MetricsError, StrokeRecord
from straightcomp_ros.straightness.guide_map import StraightnessMap

RecordMaker = Callable[..., StrokeRecord]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are saved while a test runs."""
    figures: list[Figure] = []
    save = Figure.savefig

    def keep(figure: Figure, *arguments: object, **options: object) -> None:
        figures.append(figure)
        save(figure, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


@pytest.fixture
def noisy_record(
    make_record: RecordMaker, motion_profile: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> StrokeRecord:
    return make_record(0.1e-6 * np.random.default_rng(4).standard_normal(motion_profile[0].size))


def _legends(figure: Figure) -> list[str]:
    legends = [legend for axes in figure.axes if (legend := axes.get_legend()) is not None]
    return [text.get_text() for legend in legends for text in legend.get_texts()]


@pytest.mark.parametrize("truth", [True, False])
def test_a_picture_shows_every_curve_whole(
    noisy_record: StrokeRecord, cosine_map: StraightnessMap, tmp_path: Path, drawn: list[Figure], truth: bool
) -> None:
    record = noisy_record if truth else dataclasses.replace(noisy_record, true_x=None, true_y=None, guide=None)
    path = plot_run(record, cosine_map, evaluate(record, cosine_map), tmp_path / "run.png", "A stroke")
    assert path.read_bytes().startswith(b"\x89PNG")
    for axes in drawn[0].axes:
        assert "/" in axes.get_xlabel() and "/" in axes.get_ylabel()
        low, high = axes.get_ylim()
        for line in axes.get_lines():
            values = np.asarray(line.get_ydata())
            assert low <= values.min() and values.max() <= high


def test_a_picture_that_cannot_be_finished_leaves_the_former_one(
    noisy_record: StrokeRecord, cosine_map: StraightnessMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, metrics = tmp_path / "run.png", evaluate(noisy_record, cosine_map)
    path.write_bytes(b"former")

    def interrupted(figure: Figure, file: BytesIO, **_: object) -> None:
        file.write(b"half a picture")
        raise KeyboardInterrupt

    monkeypatch.setattr(Figure, "savefig", interrupted)
    with pytest.raises(KeyboardInterrupt):
        plot_run(noisy_record, cosine_map, metrics, path, "A stroke")
    assert path.read_bytes() == b"former" and list(tmp_path.iterdir()) == [path]


def test_the_legend_gives_the_figures(
    noisy_record: StrokeRecord, cosine_map: StraightnessMap, tmp_path: Path, drawn: list[Figure]
) -> None:
    metrics = evaluate(noisy_record, cosine_map)
    plot_run(noisy_record, cosine_map, metrics, tmp_path / "run.png", "A stroke")
    legends = _legends(drawn[0])
    assert metrics.true_pp is not None
    for figure in (metrics.encoder_pp, metrics.true_pp, metrics.residual_pp, metrics.uncompensated_pp):
        assert any(f"{figure * 1e6:.2f} µm p-p" in legend for legend in legends)
    assert {"forward stroke", "backward stroke"} <= set(legends)


def test_one_way_is_drawn_without_the_other(
    noisy_record: StrokeRecord, cosine_map: StraightnessMap, tmp_path: Path, drawn: list[Figure]
) -> None:
    one_way = StrokeRecord(law="x", **{name: values[:15_500] for name, values in noisy_record.columns().items()})
    plot_run(one_way, cosine_map, evaluate(one_way, cosine_map), tmp_path / "run.png", "One way")
    legends = _legends(drawn[0])
    assert not any("backward" in legend for legend in legends)


def test_drawing_does_not_touch_pyplot(noisy_record: StrokeRecord, cosine_map: StraightnessMap, tmp_path: Path) -> None:
    loaded = "matplotlib.pyplot" in sys.modules
    plot_run(noisy_record, cosine_map, evaluate(noisy_record, cosine_map), tmp_path / "run.png", "A stroke")
    assert ("matplotlib.pyplot" in sys.modules) == loaded


def test_a_record_without_motion_is_refused(
    noisy_record: StrokeRecord, cosine_map: StraightnessMap, tmp_path: Path
) -> None:
    metrics = evaluate(noisy_record, cosine_map)
    standing = dataclasses.replace(noisy_record, x=np.full(noisy_record.x.size, 0.5))
    with pytest.raises(MetricsError, match="does not move"):
        plot_run(standing, cosine_map, metrics, tmp_path / "run.png", "Nothing")
