"""The bench of the history: a few bags, and every figure measured."""

import json
from pathlib import Path

from trials.__main__ import run as run_rig
from trials.generated_bags import template_of, write_bag

BAG = Path(__file__).resolve().parents[2] / "bags" / "smc"


def test_the_bench_measures_every_figure_and_finds_the_same_everywhere(capsys):
    assert run_rig(["history", "--bags", "3"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["bags"] == 3 and figures["strokes"] == 6
    assert figures["dask_same"] is True
    for way in ("here", "dask"):
        assert figures[way]["bags_per_s"] > 0.0 and figures[way]["memory_mb"] > 10.0
        assert figures[way]["cpu_ms_per_bag"] > 0.0
    assert figures["again_s"] > 0.0 and figures["query_s"] > 0.0


def test_each_number_makes_another_bag_and_the_same_one_again(tmp_path):
    template = template_of(BAG)

    def bag(name, number):
        write_bag(template, tmp_path / name / "run", number)
        again = template_of(tmp_path / name / "run")
        columns = [column.tobytes() for stream in again.streams.values() for column in stream.columns.values()]
        return columns, again.attachments

    assert bag("first", 7) == bag("again", 7) != bag("other", 8)


def test_no_bags_are_refused(capsys):
    assert run_rig(["history", "--bags", "0"]) == 2
    assert "--bags 0; allowed: 1 to" in capsys.readouterr().err
