"""What a client that was killed left in the nodes is not taken for what they were given at their start."""

import json

from straightcomp_ros.tuning.graph.machine_access import FirstParameters

FOUND = {"driver": {"watch.travel": 0.1, "hardware": "simulated"}, "logger": {"output": ""}}
LEFT = {"driver": {"watch.travel": 3e-6, "hardware": "simulated"}, "logger": {"output": "bags/shake"}}
PROCESSES = {"driver": "01", "logger": "02"}


def test_the_next_client_finds_the_parameters_that_the_killed_one_found(tmp_path):
    FirstParameters(FOUND, PROCESSES, tmp_path).keep()
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == FOUND


def test_a_node_that_was_started_anew_has_new_parameters(tmp_path):
    FirstParameters(FOUND, PROCESSES, tmp_path).keep()
    anew = FirstParameters({**LEFT, "driver": {"watch.travel": 0.2}}, {**PROCESSES, "driver": "03"}, tmp_path)
    assert anew.values == {"driver": {"watch.travel": 0.2}, "logger": FOUND["logger"]}


def test_nodes_that_were_released_keep_what_they_are_given_later(tmp_path):
    first = FirstParameters(FOUND, PROCESSES, tmp_path)
    first.keep()
    first.forget()
    assert not list(tmp_path.iterdir())
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == LEFT


def test_a_file_of_nonsense_counts_for_nothing(tmp_path):
    FirstParameters(FOUND, PROCESSES, tmp_path).keep()
    for file in tmp_path.iterdir():
        file.write_text(json.dumps(FOUND)[:20])
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == LEFT
