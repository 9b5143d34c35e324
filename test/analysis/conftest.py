"""A made-up machine for the tests of the analysis: guide, map and records whose figures are known."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from surveys import one_run

from straightcomp_ros.analysis import map_page, pictures
from straightcomp_ros.analysis.assessment import Assessment
from straightcomp_ros.analysis.evaluation import BagEvaluation
from straightcomp_ros.analysis.interruption import encoder_run
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.straightness.guide_map import StraightnessMap

STROKE, PERIOD, QUANTUM = 1.76, 5e-4, 0.1e-6
REST = 0.25  # s before, between and after the strokes


@pytest.fixture(scope="session")
def motion_profile() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """time (n,) in s and true x (n,) in m: rest, forward, pause, backward, rest."""
    trajectory = Trajectory(forward_and_back(MotionParameters(settle=REST, pause=REST)))
    stamps = range(0, trajectory.end_ns, round(PERIOD * 1e9))
    return np.arange(len(stamps)) * PERIOD, np.array([trajectory.position(stamp) for stamp in stamps])


@pytest.fixture(scope="session")
def cosine_map() -> StraightnessMap:
    """A guide of 20 µm peak to peak: two and a half waves of a cosine."""
    x = np.linspace(0.0, STROKE, 353)
    return StraightnessMap(one_run(x, 10e-6 * np.cos(2.0 * np.pi * 2.5 * x / STROKE)))


@pytest.fixture(scope="session")
def assessed() -> Callable[..., Assessment]:
    """A function that assesses a bag of this record without losses, with other values of its evaluation where named."""

    def made(record: StrokeRecord, bag: str = "bag", warnings: tuple[str, ...] = (), **changes: Any) -> Assessment:
        every = np.round(record.time * 1e9).astype(np.int64)
        values = {
            "lost_references": 0,
            "lost_commands": 0,
            "latency": np.full(100, 250e-6),
            "lateness": np.zeros(100),
            "stamps": every,
            "amplifier_on": np.ones(len(every), bool),
            "parameters": {"controller": {"stage.actuator.current_limit": 0.5}},
        } | changes
        stamps = values["stamps"]
        x = np.interp(stamps - values.get("begin_ns", 0), every, record.x)
        run = encoder_run(stamps, x, values["amplifier_on"], int(stamps[-1]))
        found = Assessment(Path(bag), BagEvaluation(record, **values, encoder=run))
        found.warnings = warnings
        return found

    return made


RecordMaker = Callable[..., StrokeRecord]


@pytest.fixture(scope="session")
def make_record(
    motion_profile: tuple[NDArray[np.float64], NDArray[np.float64]], cosine_map: StraightnessMap
) -> RecordMaker:
    """A function of the true error (n,) in m that makes the record of such a servo, encoders quantised."""

    def make(error: NDArray[np.float64] | float = 0.0, truth: bool = True, quantum: float = QUANTUM) -> StrokeRecord:
        time, true_x = motion_profile
        true_y = cosine_map.evaluate(true_x)[0] - error
        x = np.round(true_x / QUANTUM) * QUANTUM
        return StrokeRecord(
            time=time,
            x=x,
            y=np.round(true_y / quantum) * quantum,
            r=cosine_map.evaluate(x)[0],
            current=np.where(np.arange(time.size) % 2 == 0, 1e-3, -1e-3),
            law="made up",
            true_x=true_x if truth else None,
            true_y=true_y if truth else None,
            guide=cosine_map.deviations(true_x) if truth else None,
        )

    return make


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that would be saved."""
    figures: list[Any] = []
    for module in (map_page, pictures):
        monkeypatch.setattr(module, "save_whole", lambda figure, path: figures.append(figure))
    return figures
