"""`straightcomp robustness`: figures of many machines, the same numbers however the trials are spread."""

import math
import sys
from functools import partial
from itertools import zip_longest

import pytest

from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.offline.workers import WorkersError
from straightcomp_ros.parameters.output_files import plain
from straightcomp_ros.tuning.sweep.trial import TrialResult, plot_sweep, run_trials, summarise, sweep

SHORT = ["--set", "stage.motion.stroke=0.02", "--set", "stage.motion.settle=0.1", "--set", "stage.motion.pause=0.1"]


@pytest.fixture
def robustness(verb):
    """`straightcomp robustness` of a short stroke, in one process."""
    return partial(verb, "robustness", *SHORT, "--jobs", 1)


def test_json_holds_the_figures_of_each_law_and_the_plot_is_written(robustness, tmp_path):
    plot = tmp_path / "robustness.png"
    printed = robustness("--law", "linear", "--law", "smc", "--trials", 3, "--json", "--plot", plot).json
    assert set(printed) == {"trials", "seed", "laws", "seconds", "verdict", "reason"}
    assert printed["verdict"] == "in_order"
    assert printed["trials"] == 3 and list(printed["laws"]) == ["linear", "smc"]
    for figures in printed["laws"].values():
        assert {"pp_um", "rms_um", "not_in_order", "verdicts", "worst_trial", "verdict", "reason"} <= set(figures)
        assert 0.0 < figures["pp_um"]["p5"] <= figures["pp_um"]["p50"] <= figures["pp_um"]["max"] < 10.0
    assert plot.read_bytes().startswith(b"\x89PNG")


def summary_of(errors, *words):
    """The only summary of machines with these errors in µm, and these words of verdicts, in order by default."""
    (summary,) = summarise(
        TrialResult(trial, "linear", 1e-6 * pp, 1e-7, 1.0, 1e-3, Verdict(word, f"error of machine {trial}"))
        for trial, (pp, word) in enumerate(zip_longest(errors, words, fillvalue="in_order"))
    )
    return summary


def test_every_percentile_is_a_trial_that_was_run():
    summary = summary_of([1, 2, 4, 8])
    assert set(summary.percentiles("pp").values()) <= {1e-6, 2e-6, 4e-6, 8e-6}
    assert summary.percentiles("pp")["max"] == 8e-6 and summary.to_display()["worst_trial"] == 3


def test_a_machine_alone_is_the_machine_of_the_sweep(robustness):
    def figures(*options):
        return robustness("--law", "smc", "--json", *options).json["laws"]["smc"]

    of_three = figures("--trials", 3)
    alone = figures("--trial", of_three["worst_trial"])
    assert alone["pp_um"]["p50"] == of_three["pp_um"]["max"] and alone["worst_trial"] == of_three["worst_trial"]


def test_a_cycle_that_broke_off_counts_and_is_null_in_json(tmp_path):
    summary, none_ended = summary_of([1, math.inf], "in_order", "inaccurate"), summary_of([math.inf], "inaccurate")
    shown = plain(summary.to_display())
    assert shown["pp_um"]["p50"] == pytest.approx(1.0) and shown["pp_um"]["max"] is None
    assert shown["not_in_order"] == 1 and shown["verdicts"] == {"inaccurate": 1}
    assert shown["machines_not_in_order"][0]["pp_um"] is None
    for number, one in enumerate((summary, none_ended)):
        plot_sweep([one], tmp_path / f"{number}.png", "broken off")
        assert (tmp_path / f"{number}.png").is_file()


def test_the_verdict_on_a_law_is_its_most_frequent_one_and_names_a_machine_whose_percentiles_are_doubtful():
    summary = summary_of([1, 2, 3, 4], "in_order", "at_stop", "oscillates", "oscillates")
    assert summary.verdict.verdict == "oscillates"
    assert summary.verdict.reason == "oscillates 2, at_stop 1 of 4 machines; machine 2: error of machine 2"
    assert [one.trial for one in summary.not_in_order] == [1, 2, 3]
    good = summary_of([1])
    assert good.verdict.in_order and "1 machines" in good.verdict.reason and good.doubtful == set()
    assert summary_of(range(1, 11), *["in_order"] * 9, "oscillates").doubtful == {"p95", "max"}


def test_a_machine_that_is_not_in_order_fails_the_command_and_is_marked_and_named(robustness):
    # The paper's switching law with sgn σ: it oscillates by itself.
    sgn = ["--set", "controller.control.smc.boundary_layer=0.0", "--set", "stage.motion.stroke=0.1", "--law", "smc"]
    failed = robustness(*sgn, "--trials", 2, "--json")
    assert failed.code == 1 and "not in order: oscillates" in failed.err
    assert failed.json["verdict"] == "oscillates" and "law 'smc'" in failed.json["reason"]
    figures = failed.json["laws"]["smc"]
    assert figures["not_in_order"] == figures["verdicts"]["oscillates"] == 2
    assert [one["trial"] for one in figures["machines_not_in_order"]] == [0, 1]
    code, out, _ = robustness(*sgn, "--trials", 1)
    printed = " ".join(out.split())
    assert code == 1 and " ! " in printed and "worst" in printed and "--machine K" in printed
    assert "Verdict on smc: oscillates: oscillates 1 of 1 machines" in printed


TRIALS = 5


def test_two_processes_give_what_one_gives(scenario):
    fractions = []
    results = sweep(scenario, 9, range(TRIALS), jobs=2, progress=fractions.append)
    assert results == run_trials(scenario, 9, range(TRIALS))
    assert fractions[0] == 0.0 and fractions[-1] == 1.0 and fractions == sorted(fractions)


@pytest.mark.nightly
def test_dask_workers_give_what_this_machine_gives_to_the_last_bit(scenario, scheduler):
    assert sweep(scenario, 9, range(TRIALS), dask=scheduler) == sweep(scenario, 9, range(TRIALS), jobs=2)


@pytest.mark.nightly
@pytest.mark.parametrize("address", ["127.0.0.1:9", "nowhere://1"])
def test_a_scheduler_that_is_not_there_is_named(scenario, monkeypatch, address):
    monkeypatch.setattr("straightcomp_ros.offline.workers._CONNECT_S", 1.0)
    with pytest.raises(WorkersError, match=address):
        sweep(scenario, 9, range(1), dask=address)


def test_without_dask_the_remedy_is_named(scenario, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(WorkersError, match="pip install"):
        sweep(scenario, 9, range(1), dask="127.0.0.1:8786")
