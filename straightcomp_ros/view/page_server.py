"""The page's server, and the decimated series that it shows.

It is the standard library's, on the loopback interface only; news come by server-sent events. Reading needs the
page's address alone. Buttons need the token that `straightcomp view` prints, and come as POST requests of JSON: another
site's page can send neither the token nor, without asking first, JSON.
"""

import json
import math
import secrets
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

import numpy as np

from straightcomp_ros.analysis.style import SHEET
from straightcomp_ros.parameters.output_files import plain

_KEEP_S = 20.0
_NEWS_EVERY_S = 0.1
_MOST_CONNECTIONS = 16
_LONGEST_BODY = 4096
_IDLE_S = 30.0
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; img-src data:"
_GUARDS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}

Action = Callable[[], str]
"""A button's action; returns the message for the page. Raises ActionRefused."""


class ActionRefused(Exception):
    """The graph refused; the message says why."""


class Series:
    """One quantity in slots of ``slot`` s, each with the least and the greatest value: no peak is lost.

    ``scale`` is the shown unit per SI unit, e.g. 1e6 for µm, with the sign. The last 20 s are kept.
    """

    def __init__(self, slot: float, scale: float) -> None:
        self._slot_ns, self._scale = round(slot * 1e9), scale
        self._slots: deque[list[float]] = deque(maxlen=round(_KEEP_S / slot))
        self._number, self._low, self._high = -1, math.inf, -math.inf

    def add(self, samples: Iterable[tuple[int, float]]) -> None:
        """Add samples: (stamp in ns, value in SI units). Values that are not finite leave their slot as it is."""
        for stamp_ns, value in samples:
            number = stamp_ns // self._slot_ns
            if number != self._number:
                self._close(number)
            shown = value * self._scale
            if math.isfinite(shown):
                self._low, self._high = min(self._low, shown), max(self._high, shown)

    def _close(self, number: int) -> None:
        if number < self._number:
            # The source was started anew.
            self._slots.clear()
        elif self._low <= self._high:
            values = (float(f"{value:.7g}") for value in (self._low, self._high))
            self._slots.append([self._number, self._number * self._slot_ns * 1e-9, *values])
        self._number, self._low, self._high = number, math.inf, -math.inf

    def after(self, number: int) -> list[list[float]]:
        """Finished slots after slot ``number``: [number, time in s since the epoch, least, greatest], to 7 digits: x
        of some metres to a micrometre.

        All where none has that number: the source was started anew.
        """
        known = bool(self._slots) and number <= self._slots[-1][0]
        return [slot for slot in self._slots if not known or slot[0] > number]


def distribution(times: Sequence[float]) -> dict[str, object]:
    """Of finite ``times`` in s, any number: counts between edges in µs that are a twelfth of a decade apart, and
    percentiles in µs; empty of none."""
    us = np.sort(np.asarray(times, dtype=np.float64)) * 1e6
    if not us.size:
        return {}
    ends = np.floor(12.0 * np.log10(us[[0, -1]].clip(min=1.0)))
    edges = 10.0 ** (np.arange(ends[0], ends[1] + 2.0) / 12.0)
    p50, p99, most = np.quantile(us, (0.5, 0.99, 1.0)).tolist()
    counts = np.histogram(us.clip(min=1.0), edges)[0].tolist()
    return {"edges": edges.tolist(), "counts": counts, "p50": p50, "p99": p99, "max": most}


class ViewServer(ThreadingHTTPServer):
    """Serves the page, all series by name, the present state, and the buttons' actions by name.

    A thread for each connection reads what the thread that made the server adds and shows.

    Raises:
        OSError: the TCP port on 127.0.0.1 cannot be had; port 0 takes a free one.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64
    """With the 5 of the standard library a page among many slow clients would wait for TCP's retries of seconds."""

    def __init__(self, port: int, series: Mapping[str, Series], actions: Mapping[str, Action]) -> None:
        try:
            super().__init__(("127.0.0.1", port), _Handler)
        except OSError as error:
            raise OSError(
                f"port {port} on 127.0.0.1: {error.strerror}; name another by --port, 0 takes a free one"
            ) from None
        self._series, self.actions = series, dict(actions)
        self._state: dict[str, object] = {}
        self._shown = threading.Lock()
        self.token = secrets.token_urlsafe(16)
        page = files(__package__).joinpath("page.html").read_text(encoding="utf-8")
        self.page = page.replace("/*STYLE*/", SHEET).encode()
        self.stopping = threading.Event()
        self._open: dict[socket.socket, bool] = {}
        self._changing = threading.Lock()
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), name="view", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The page, with the token; the part behind the # stays in the browser."""
        return f"http://127.0.0.1:{self.server_port}/#{self.token}"

    def add(self, name: str, samples: Sequence[tuple[int, float]]) -> None:
        with self._shown:
            self._series[name].add(samples)

    def show(self, state: dict[str, object]) -> None:
        with self._shown:
            self._state = state

    def news(self, seen: dict[str, int]) -> dict[str, object]:
        """State, and what each series has after the slot that ``seen`` names, which is then brought up to date."""
        with self._shown:
            fresh = {}
            for name, series in self._series.items():
                fresh[name] = slots = series.after(seen.get(name, -1))
                if slots:
                    seen[name] = int(slots[-1][0])
            return {"state": self._state, "series": fresh}

    def process_request(self, request: Any, client_address: Any) -> None:
        """One connection too many ends the oldest that gets no news, or else the oldest: a client that is slow or
        silent keeps no other out."""
        with self._changing:
            if len(self._open) >= _MOST_CONNECTIONS:
                oldest = min(self._open, key=self._open.__getitem__)
                del self._open[oldest]
                with suppress(OSError):
                    # Wakes its thread, which closes it.
                    oldest.shutdown(socket.SHUT_RDWR)
            self._open[request] = False
        super().process_request(request, client_address)

    def gets_news(self, request: socket.socket) -> None:
        """From now on this connection is a page's."""
        with self._changing:
            if request in self._open:
                self._open[request] = True

    def shutdown_request(self, request: Any) -> None:
        with self._changing:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that was closed is no error, and other errors of a client are its own."""

    def close(self) -> None:
        self.stopping.set()
        self.shutdown()
        self.server_close()
        self._thread.join(5.0)


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    timeout = _IDLE_S
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        if self.path == "/":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
        elif self.path == "/news":
            self._send_news()
        else:
            self._answer(HTTPStatus.NOT_FOUND, "not found")

    def do_POST(self) -> None:
        # Whatever is left unread of a refused request must not be taken for the next one.
        self.close_connection = True
        self._answer(*self._pressed())

    def _pressed(self) -> tuple[HTTPStatus, str]:
        """Execute a button's action; status and message for the page."""
        if not secrets.compare_digest(self.headers.get("X-Token", "").encode(), self.server.token.encode()):
            return HTTPStatus.FORBIDDEN, "wrong or no token; open the address that `straightcomp view` printed"
        if self.headers.get_content_type() != "application/json":
            return HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "allowed: application/json"
        try:
            length = int(self.headers.get("Content-Length", ""))
            if not 0 <= length <= _LONGEST_BODY:
                raise ValueError
            action = self.server.actions[json.loads(self.rfile.read(length))["action"]]
        except (ValueError, KeyError, TypeError):
            return HTTPStatus.BAD_REQUEST, f'allowed: {{"action": one of {sorted(self.server.actions)}}}'
        try:
            return HTTPStatus.OK, action()
        except ActionRefused as refusal:
            return HTTPStatus.CONFLICT, str(refusal)

    def parse_request(self) -> bool:
        """Another name that DNS leads here is refused: a page under that name would count as ours."""
        if not super().parse_request():
            return False
        # Any port: a browser leaves out 80, and a tunnel has one of its own.
        if self.headers.get("Host", "").partition(":")[0].lower() in ("127.0.0.1", "localhost"):
            return True
        self.close_connection = True
        self._answer(HTTPStatus.FORBIDDEN, "allowed hosts: 127.0.0.1, localhost")
        return False

    def _send_news(self) -> None:
        self.close_connection = True
        self.server.gets_news(self.connection)
        self._send(HTTPStatus.OK, "text/event-stream")
        seen: dict[str, int] = {}
        while not self.server.stopping.wait(_NEWS_EVERY_S):
            text = json.dumps(plain(self.server.news(seen)), separators=(",", ":"), allow_nan=False)
            self.wfile.write(f"data: {text}\n\n".encode())

    def _answer(self, status: HTTPStatus, message: str) -> None:
        self._send(status, "application/json", json.dumps({"message": message}).encode())

    def _send(self, status: HTTPStatus, kind: str, body: bytes = b"") -> None:
        """Send the head and ``body``; without one, what follows ends with the connection."""
        length = {"Content-Length": str(len(body))} if body else {}
        self.send_response(status)
        for name, value in {"Content-Type": kind, **length, **_GUARDS}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Nothing: ten lines a second would be."""
