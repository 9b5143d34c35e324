"""The live view beside a running driver, as a browser uses it."""

import json
import os
import time
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest
from waiting import wait_for_line

from straightcomp_ros.cell.launcher import verb_command

pytestmark = pytest.mark.keeps_time


@pytest.fixture
def page(graph, tmp_path):
    file = tmp_path / "gantry.json"
    file.write_text(json.dumps({"stage": "a", "as_of": "2026-05-01", "advice": [{"text": "worn", "remedy": "mend"}]}))
    graph.start("driver", {"stage.rate": 200})
    limits = tmp_path / "limits.yaml"
    limits.write_text("encoder_pp_um: 0.6\ncontrol_rms_step_A: 0.1\n")
    command = verb_command("view", "--port", "0", "--maintenance", str(file), "--limits", str(limits))
    view = graph.start_program("view", command, read_output=True)
    return urlsplit(view.stdout.readline().strip())


def press(page, action):
    connection = HTTPConnection("127.0.0.1", page.port, timeout=30)
    try:
        headers = {"X-Token": page.fragment, "Content-Type": "application/json"}
        connection.request("POST", "/action", json.dumps({"action": action}), headers)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())["message"]
    finally:
        connection.close()


def test_it_shows_the_graph_and_its_buttons_reach_the_driver(page):
    connection = HTTPConnection("127.0.0.1", page.port, timeout=30)
    connection.request("GET", "/news")
    answer = connection.getresponse()
    slots, state, end = [], {}, time.monotonic() + 90
    while time.monotonic() < end and not (len(slots) > 5 and state["nodes"]["driver"]["rate_hz"]):
        line = answer.readline()
        if line.startswith(b"data: "):
            news = json.loads(line[6:])
            state = news["state"]
            slots += news["series"]["x"]
    answer.close()
    assert state["fresh"] and not state["amplifier_on"]
    assert state["limit"] == {"um": 0.6, "source": "limits.yaml"} and state["faults"] == []
    assert state["maintenance"] == "as of 2026-05-01: worn; mend"
    assert state["nodes"]["driver"]["state"] != "absent" and state["nodes"]["logger"]["state"] == "absent"
    assert float(state["nodes"]["driver"]["rate_hz"]) > 0
    assert [slot[0] for slot in slots] == sorted({slot[0] for slot in slots})
    status, message = press(page, "enable")
    assert status == 409 and message
    assert press(page, "reset")[0] == 200 and press(page, "disable") == (200, "amplifier off")


def test_a_view_without_a_graph_says_in_which_domain_it_looks(single):
    single.start_program("view", verb_command("view", "--port", "0", "--namespace", "alone"))
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    wait_for_line(single, "view", f"no node of the graph is seen in ROS domain {domain}, namespace /alone")
