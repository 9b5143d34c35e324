"""Strokes may begin anywhere on the guide."""

import json

import pytest

from straightcomp_ros.cli.main import main

SHORT = ("stage.motion.start=0.4", "stage.motion.stroke=0.2", "stage.motion.settle=0.2", "stage.motion.pause=0.1")


@pytest.mark.parametrize("cycles", ["1", "2"])
def test_a_stroke_that_does_not_begin_at_zero_is_run_by_the_compiled_loop_and_by_the_nodes_alike(
    capsys: pytest.CaptureFixture[str], cycles: str
) -> None:
    settings = [word for one in SHORT for word in ("--set", one)]
    assert main(["simulate", "--strokes", cycles, "--json", *settings]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "in_order"
