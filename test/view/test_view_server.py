"""The view's server, as an HTTP client finds it, and the series behind it."""

import json
import re
import socket
from collections import defaultdict
from contextlib import ExitStack, closing, suppress
from http.client import HTTPConnection
from itertools import islice
from unittest.mock import Mock

import pytest
from places import REPOSITORY

from straightcomp_ros.analysis.html_page import html_page
from straightcomp_ros.analysis.style import BLUE, SHEET
from straightcomp_ros.cell.observation import Observation, StrokeErrors
from straightcomp_ros.nodes import view_node
from straightcomp_ros.timing.realtime import RealtimeParameters
from straightcomp_ros.view.page_server import ActionRefused, Series, ViewServer, distribution

MS = 1_000_000


@pytest.fixture
def server():
    pressed = []

    def refuse():
        raise ActionRefused("a fault is latched")

    made = ViewServer(
        0, {"error": Series(0.02, 1e6)}, {"enable": refuse, "reset": lambda: pressed.append("reset") or "faults reset"}
    )
    made.pressed = pressed
    yield made
    made.close()


def ask(server, method, path, body=None, **headers):
    with closing(HTTPConnection("127.0.0.1", server.server_port, timeout=30)) as connection:
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def press(server, action, **headers):
    given = {"X_Token": server.token, "Content_Type": "application/json", **headers}
    status, _, body = ask(server, "POST", "/action", json.dumps({"action": action}), **given)
    return status, json.loads(body)["message"]


def opened(server):
    """The open answer with the news; it owns its socket."""
    connection = HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.request("GET", "/news")
    return connection.getresponse()


def news(server, count):
    with opened(server) as answer:
        assert answer.headers["Content-Type"] == "text/event-stream"
        lines = (line for line in iter(answer.readline, b"") if line.startswith(b"data: "))
        return [json.loads(line[6:]) for line in islice(lines, count)]


def test_the_page_is_for_this_machine_under_its_own_names_and_needs_nothing_from_elsewhere(server):
    status, headers, body = ask(server, "GET", "/")
    text = body.decode()
    for host, answered in (("evil.example", 403), ("localhost", 200)):
        assert ask(server, "GET", "/", Host=f"{host}:{server.server_port}")[0] == answered
    # As a browser has it for port 80, and behind a tunnel.
    assert {ask(server, "GET", "/", Host=host)[0] for host in ("127.0.0.1", "LocalHost:9000")} == {200}
    assert server.server_address[0] == "127.0.0.1"
    assert status == 200 and "default-src 'none'" in headers["Content-Security-Policy"]
    assert "http://" not in text and "https://" not in text and "src=" not in text and "@import" not in text
    assert server.token not in text
    assert ask(server, "GET", "/etc/passwd")[0] == 404


def test_a_port_that_is_taken_is_refused_with_what_to_do(server):
    with pytest.raises(OSError, match=f"^port {server.server_port} on 127.0.0.1: Address already in use; name another"):
        ViewServer(server.server_port, {}, {})


def test_every_page_has_the_one_style_sheet_and_pictures_its_colours(server):
    docs = REPOSITORY / "docs"
    pages = ask(server, "GET", "/")[2].decode(), html_page("a", "a", "", []), (docs / "css" / "style.css").read_text()
    assert all(SHEET.strip() in page for page in pages) and BLUE == "#0072B2"
    assert "extra_css: [css/style.css]" in (REPOSITORY / "mkdocs.yml").read_text()


@pytest.mark.parametrize(("rate", "gap"), [(2000, 3.0), (100, 15.0)])
def test_the_page_shows_faults_with_their_remedy_the_limit_and_what_the_view_says_of_rest_and_of_time_between_positions(
    server, monkeypatch, rate, gap
):
    strokes, shown = StrokeErrors(), []
    graph = Mock(strokes=strokes, **{"reports.return_value": {}, "observation.return_value": Observation()})
    driver = defaultdict(float, {"stage.rate": rate, "stage.motion.speed": 2e-4, "stage.encoder.x_resolution": 1e-7})
    stand_ins = {"GraphClient": graph, "RemoteParameters": Mock(values={"driver": driver})}
    stand_ins["ViewServer"] = Mock(show=shown.append)
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(view_node, name, Mock(return_value=stand_in))
    view_node.ViewNode(Mock(), 0, Mock(), RealtimeParameters(), "", None)._show()
    page = ask(server, "GET", "/")[2].decode()
    for name in ("fault.means", "fault.causes", "fault.remedy", "state.limit.um", "limit.source"):
        assert name in page
    read = set(re.findall(r"\bstate\.(\w+)", page))
    assert {"rest", "gap"} <= read <= shown[0].keys()
    assert shown[0]["gap"] == pytest.approx(gap) and shown[0]["rest"] == strokes.rest != StrokeErrors().rest


def test_the_distribution_of_latencies_counts_each_once():
    found = distribution([100e-6] * 98 + [2e-3, 50e-3])
    assert sum(found["counts"]) == 100 and found["p50"] == pytest.approx(100.0) and found["max"] == pytest.approx(50e3)
    assert found["edges"][0] <= 100.0 and found["edges"][-1] >= 50e3 and distribution([]) == {}


def test_news_hold_the_state_and_each_slot_once(server):
    server.show({"fresh": True, "x_mm": float("nan")})
    server.add("error", [(1000 * MS + k * MS, 1e-6 * k) for k in range(100)])
    first, second = news(server, 2)
    assert first["state"] == {"fresh": True, "x_mm": None}
    assert [slot[2:] for slot in first["series"]["error"]] == [[0, 19], [20, 39], [40, 59], [60, 79]]
    assert second["series"]["error"] == []


def test_buttons_work_with_the_token_and_a_refusal_is_the_answer(server):
    assert press(server, "reset") == (200, "faults reset") and server.pressed == ["reset"]
    assert press(server, "enable") == (409, "a fault is latched")
    assert press(server, "explode")[0] == 400


@pytest.mark.parametrize(
    "headers, status",
    [
        ({"X_Token": "guess"}, 403),
        ({"X_Token": ""}, 403),
        ({"Content_Type": "text/plain"}, 415),
        ({"Host": "evil.example:80"}, 403),
        ({"Content_Length": "99999999"}, 400),
        ({"Content_Length": "x"}, 400),
    ],
)
def test_whatever_another_page_could_send_is_refused(server, headers, status):
    assert press(server, "reset", **headers)[0] == status
    assert not server.pressed


def test_a_page_gets_in_however_many_others_are_open(server):
    with ExitStack() as pages:
        for _ in range(20):
            pages.enter_context(opened(server)).readline()
        assert ask(server, "GET", "/")[0] == 200
        assert len(news(server, 1)) == 1


@pytest.mark.parametrize(
    "said", [b"", b"G", b"POST /action HTTP/1.1\r\nContent-Length: 4000\r\n", b"GET / HTTP/1.1\r\nX: "]
)
def test_clients_that_are_slow_end_before_a_page_that_gets_news(server, said):
    # News of some kilobytes, to read past those that were sent before the slow clients came.
    server.show({"filler": "x" * 4096})
    with ExitStack() as connections:
        watched = connections.enter_context(opened(server))
        for one in [socket.create_connection(("127.0.0.1", server.server_port)) for _ in range(40)]:
            connections.enter_context(one)
            with suppress(OSError):
                one.sendall(said)
        assert ask(server, "GET", "/")[0] == 200
        watched.read(1 << 14)
        assert watched.readline()


@pytest.mark.parametrize(
    ("factor", "values", "slot"),
    [
        # A peak of one sample is kept, and what is not finite is not.
        (1.0, [*[1.0] * 7, 50.0, float("nan"), *[1.0] * 16], [1.0, 50.0]),
        # Some metres along the guide, to a micrometre.
        (1e3, [2.345678 + k * 1e-6 for k in range(25)], [2345.678, 2345.697]),
        # The least value comes first under a negative factor too.
        (-1e3, [k * 1e-3 for k in range(25)], [-19.0, 0.0]),
    ],
)
def test_a_slot_has_the_least_and_the_greatest_value_and_comes_once(factor, values, slot):
    series = Series(0.02, factor)
    series.add([(k * MS, value) for k, value in enumerate(values)])
    assert series.after(-1) == [[0, 0.0, *slot]] and series.after(0) == []


def test_a_source_that_starts_anew_is_sent_from_its_start(server):
    seen = {}
    for begin in (5000, 0):
        server.add("error", [(k * MS, 1.0) for k in range(begin, begin + 100)])
        assert len(server.news(seen)["series"]["error"]) == 4
    assert server.news(seen)["series"]["error"] == []
