"""Feeds the live view: reads and decimates the graph's streams, passes the page's button presses to the driver."""

import math
import os
import queue
from collections import deque
from collections.abc import Callable
from functools import partial

from rclpy.task import Future

from straightcomp_ros.cell.launcher import RECORDED
from straightcomp_ros.contract import CONTROLLER_STATE, DRIVER_STATE, POSITION, POSITION_EVERY, REFERENCE
from straightcomp_ros.runtime.graph_client import GraphClient, RemoteParameters
from straightcomp_ros.runtime.guarded_node import GuardedNode
from straightcomp_ros.runtime.runner import Runnable
from straightcomp_ros.safety.faults import explained
from straightcomp_ros.stage.due_maintenance import due_maintenance
from straightcomp_ros.timing.node_timing import LOST, OVERRUNS, RATE
from straightcomp_ros.timing.realtime import RealtimeParameters
from straightcomp_ros.view.page_server import ActionRefused, Series, ViewServer, distribution

_FETCH_S = 0.05
SLOT_S = 0.02
_GAP_SLOTS = 3
"""Most slots from one value of a curve to the next, where positions do not come less often."""
_ANSWER_WITHIN_S = 2.0
_ALONE_S = 5.0
"""Time from which a view that sees no node says so: discovery takes a second or two."""
_LATENCIES, _SUMMARY_EVERY = 40_000, 20
"""Latencies whose distribution is shown: of 20 s at 2 kHz; and of how many fetches one counts them anew."""
SHOWN = {
    # Deviation of the guide by the map: the negative of the reference.
    "deviation": (REFERENCE, "r", -1e6),
    "y": (POSITION, "y", 1e6),
    "error": (CONTROLLER_STATE, "error", 1e6),
    "sigma": (CONTROLLER_STATE, "sliding_variable", 1e3),
    "latency": (DRIVER_STATE, "command_latency", 1e6),
    "x": (POSITION, "x", 1e3),
}
"""Series: stream, column, factor for µm, mm/s, µs or mm."""
_OF_NODE = {"rate_hz": RATE, "overruns": OVERRUNS, "lost": LOST, "late_p99_us": "timer_error_p99_us"}
"""Name in the diagnostics, by name on the page."""


class ViewNode(Runnable):
    """Serves the page at ``port`` and calls ``ready`` with its address. Only the main thread uses ROS; others serve it.

    ``realtime`` must equal that of the graph's nodes: see docs/realtime.md. ``maintenance`` is a file of advice, empty
    for none. ``limit`` is shown with the error: ``um``, the largest p-p of a movement, and ``source``, whose it is.
    """

    def __init__(
        self,
        node: GuardedNode,
        port: int,
        ready: Callable[[str], object],
        realtime: RealtimeParameters,
        maintenance: str,
        limit: dict[str, object] | None,
    ) -> None:
        self._limit = limit
        self._maintenance, self._due = maintenance, ""
        self.node, self.done, self.realtime = node, Future(), realtime
        self._graph = GraphClient(node, RECORDED, batches=(CONTROLLER_STATE, DRIVER_STATE, REFERENCE))
        self._driver = RemoteParameters(node, ("driver",))
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._distribution: dict[str, object] = {}
        self._fetches = 0
        self._wanted: list[Callable[[], None]] = []
        buttons = {
            "enable": partial(self._ask, "driver/enable", True, "amplifier on"),
            "disable": partial(self._ask, "driver/enable", False, "amplifier off"),
            "reset": partial(self._ask, "driver/reset_fault", None, "faults reset"),
        }
        self._own, self._on = False, False
        """Whether a page switched the amplifier on, and whether it was seen on since."""
        self._look = node.create_timer(_ALONE_S, self._say_if_alone)
        series = {name: Series(SLOT_S, factor) for name, (*_, factor) in SHOWN.items()}
        self._server = ViewServer(port, series, buttons)
        node.create_timer(_FETCH_S, self._fetch)
        ready(self._server.url)

    def _fetch(self) -> None:
        if self.done.done():
            return
        fetched = self._graph.fetch()
        for name, (stream, column, _) in SHOWN.items():
            place = stream.layout.columns.index(column)
            self._server.add(name, [(stamp_ns, numbers[place]) for stamp_ns, numbers, _ in fetched[stream]])
        place = DRIVER_STATE.layout.columns.index("command_latency")
        self._latencies.extend(n[place] for _, n, _ in fetched[DRIVER_STATE] if math.isfinite(n[place]))
        if self._fetches % _SUMMARY_EVERY == 0:
            self._distribution = distribution(self._latencies)
            self._due = due_maintenance(self._maintenance)
        self._fetches += 1
        while self._wanted:
            self._wanted.pop(0)()
        self._show()

    def _say_if_alone(self) -> None:
        self._look.cancel()
        if self._graph.observation().alone:
            domain, place = os.environ.get("ROS_DOMAIN_ID", "0"), self.node.get_namespace()
            self.node.get_logger().warning(
                f"no node of the graph is seen in ROS domain {domain}, namespace {place}: start one, or begin the view "
                "with the ROS_DOMAIN_ID and --namespace of one that runs; `straightcomp demo` prints its domain"
            )

    def _show(self) -> None:
        seen = self._graph.observation()
        reports = self._graph.reports()
        # What the driver said last: that there are no samples does not switch off.
        on = self._graph.safety.amplifier_on
        self._on = self._own and (self._on or on)
        # A fault may come before the amplifier was seen on.
        self._own = self._own and (on or not (self._on or self._graph.safety.fault))
        nodes = {
            node: {"state": state} | {shown: reports.get(node, {}).get(key, "") for shown, key in _OF_NODE.items()}
            for node, state in seen.nodes.items()
        }
        driver = self._driver.values.get("driver", {})
        if driver:
            self._graph.strokes.expect(driver["stage.motion.speed"], driver["stage.encoder.x_resolution"])
        named = f"stage “{driver['stage.name']}”, hardware {driver['hardware']}" if driver else ""
        self._server.show(
            {
                "stage": named,
                "due_us": 1e6 * driver["stage.drive.delay"] / driver["stage.rate"] if driver else None,
                "latency": self._distribution,
                "limit": self._limit,
                "rest": self._graph.strokes.rest,
                "gap": max(_GAP_SLOTS, 1.5 * POSITION_EVERY / (driver.get("stage.rate", math.inf) * SLOT_S)),
                "fresh": seen.fresh,
                "amplifier_on": seen.amplifier_on,
                "x_mm": seen.x * 1e3,
                "stroke_error_pp_um": seen.stroke_error_pp * 1e6,
                "faults": [{"node": node, **explained(text)} for node, text in seen.faults.items()],
                "maintenance": self._due,
                "nodes": nodes,
            }
        )

    def _ask(self, service: str, on: bool | None, done: str) -> str:
        """Called by a thread of the page: let the main thread call a service, and wait for its answer."""
        refusals: queue.Queue[str] = queue.Queue()

        def answered(refusal: str) -> None:
            if on:
                self._own, self._on = self._own or not refusal, False
            refusals.put(refusal)

        self._wanted.append(partial(self._graph.request, service, on, answered))
        try:
            refusal = refusals.get(timeout=_ANSWER_WITHIN_S)
        except queue.Empty:
            refusal = "the driver does not answer"
        if refusal:
            raise ActionRefused(refusal)
        return done

    def leave(self) -> Future | None:
        """Switch the amplifier off if a page switched it on: without the page no client can switch it off."""
        return self._graph.leave() if self._own else None

    def close(self) -> None:
        """Stop serving the page; the graph keeps running."""
        self._server.close()
