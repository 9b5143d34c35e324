"""What the rig of live strokes makes of its strokes; the strokes themselves are made up."""

import json
import time
from pathlib import Path

import pytest

from straightcomp_ros.cell.demonstration import DemonstrationFailed
from straightcomp_ros.parameters.share import share_path
from trials import strokes
from trials.__main__ import run

pytestmark = pytest.mark.nightly
PAIR = ["strokes", "--runs", "3", "--loads", "quiet", "--priorities", "0"]
PAIR += ["--pair", str(share_path("config/stage_synthetic.yaml"))]


@pytest.fixture
def rig(monkeypatch, capsys):
    """``rig(beside)``: exit code and output of a run whose strokes leave 0.1 µm, beside another stage ``beside`` µm."""

    def rows(beside):
        def made(condition, stages, folder):
            if beside is None and len(condition.stages) > 1:
                raise DemonstrationFailed("the driver died")
            pp = 0.1 if len(condition.stages) == 1 else beside
            words = {"verdict": "in_order", "reason": "", "held_up": ""}
            numbers = {"step_mA": 3.0, "latency_p50_us": 20.0, "latency_p99_us": 75.0, "lost_samples": 0}
            return {stage: {"pp_um": pp, **numbers, **words} for stage in condition.stages}

        monkeypatch.setattr(strokes, "run_together", made)
        code = run(PAIR)
        return code, json.loads(capsys.readouterr().out)

    return rows


@pytest.mark.parametrize(("beside", "code"), [(0.12, 0), (0.13, 1)])
def test_a_pair_passes_where_neither_stage_has_much_more_error_beside_the_other_than_alone(rig, beside, code):
    found, printed = rig(beside)
    assert found == code and printed["passed"] is not bool(code)
    pairs = [one for one in printed["rows"] if len(one["stages"]) == 2]
    assert [(one["graph"], one["stage"]) for one in pairs] == [(g, s) for g in strokes.GRAPHS for s in "ab"]
    assert all(one["ratio_to_alone"] == pytest.approx(beside / 0.1) and one["strokes"] == 3 for one in pairs)


def test_a_stroke_that_failed_is_named_with_its_condition(rig):
    code, printed = rig(None)
    assert code == 1 and len(printed["failures"]) == 6
    assert printed["failures"][0] == "separate_quiet_0_a_b/1: the driver died"


def test_a_load_writes_to_the_disk_while_it_lasts_and_leaves_nothing(tmp_path):
    def children():
        return Path("/proc/thread-self/children").read_text().split()

    before = children()
    with strokes.loaded(True, tmp_path):
        end = time.monotonic() + 30.0
        while not (tmp_path / "written").exists() and time.monotonic() < end:
            time.sleep(0.05)
        assert (tmp_path / "written").exists() and len(children()) - len(before) == strokes.BUSY + 1
    assert not list(tmp_path.iterdir()) and children() == before
    with strokes.loaded(False, tmp_path):
        assert children() == before
