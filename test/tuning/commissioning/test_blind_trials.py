"""The script of the blind trials keeps what it has found."""

import json

import pytest

from scripts import blind_trials

ROW = {"pp_um": 0.2, "full_pp_um": 0.2, "ratio": 1.0, "verdict": "in_order", "rest_pp_um": 0.0, "strokes": 1}


def test_a_trial_is_kept_and_not_made_again_and_an_interrupted_one_begins_anew(tmp_path, monkeypatch, capsys):
    made = []

    def trial(values, folder, evaluations, machines):
        made.append(sorted(path.name for path in folder.iterdir()))
        (folder / "left").touch()
        if len(made) == 2:
            raise KeyboardInterrupt
        return {**ROW, "farthest_share_of_stop": 0.1}

    monkeypatch.setattr(blind_trials, "trial", trial)
    command = ["test/tuning/commissioning/rough.yaml", "--machines", "2", "-o", str(tmp_path / "trials")]
    with pytest.raises(KeyboardInterrupt):
        blind_trials.main(command)
    with pytest.raises(SystemExit, match="0"):
        blind_trials.main(command)
    assert made == [[], [], []]
    assert json.loads((tmp_path / "trials" / "machine_1" / "trial.json").read_text())["machine"] == 1
    assert "2 machines: 2 in order" in capsys.readouterr().out
