"""A running graph as a machine under commissioning: one that runs already, or one that is started for it.

A client that is killed leaves its own parameters in the nodes: a travel of 3 µm in the driver, the law `open_loop` in
the controller. The next client must not take these for the machine's.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.analysis.judged_motion import is_simulated
from straightcomp_ros.cell.demonstration import emulated_machine, on_hub
from straightcomp_ros.cell.launcher import COMPOSED, IN_THE_LOOP, RECORDED, Graph, LaunchError, isolated_environment
from straightcomp_ros.control.excitation import ExcitationEnded, ExcitationParameters, MultisineParameters
from straightcomp_ros.control.laws import OPEN_LOOP
from straightcomp_ros.model.motion import MotionParameters, forward_and_back, jog
from straightcomp_ros.model.paced_motion import ARRIVED_M, AT_START_M
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.parameters.declaration import belongs_to_ros, to_mapping, under
from straightcomp_ros.parameters.node_parameters import STAGE, Values, node_parameters
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.parameters.share import make_private, private_folder
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.timing.cpus import use_kept_free
from straightcomp_ros.timing.node_timing import EXCITATION, EXCITING, FINISHED
from straightcomp_ros.tuning.commissioning import CommissioningError, LeftTravel
from straightcomp_ros.tuning.commissioning.machine import Series, excited, recorded_reading, recorded_series
from straightcomp_ros.tuning.frequency_response.measured_response import ComparedResponse, response_from_bag
from straightcomp_ros.tuning.graph.waiting_client import ANSWER_S, WaitingClient

_AT_ONCE = ("excitation.", "error_limit")
"""Parameters of the controller that change without a bump, so that it need not be configured again."""
_AT_START = ("autostart", "realtime.")
"""Those that are fixed when a process starts."""
_TRAVEL = "watch.travel"
_RECORDING = ("output", "record_at_start")
_START_S = 60.0
_CREEP_S = 0.1
"""s in which the magnets show whether they pull the platform away by themselves."""
_SETTLE_S = 0.5
"""s in which a law takes the platform to its reference."""
_AFTER_S = 0.3
"""s that a recording goes on after the amplifier went off: batches are on their way."""
_LATE_S = 5.0
_REPORTED_S = 5.0
"""s after a request in which a report may still be of before it: nodes report once a second."""
_SEEN_NS = 500_000_000
"""A stage that is away for longer is seen there: the client's observation is 50 ms old, or more on a slow host."""


class RunningMachine:
    """Drives the nodes of a graph by their services; what it records is in ``folder``.

    The driver keeps its parameters; controller, feedforward and logger get those of each call, and their first ones
    again at the end, see :meth:`release`. ``values`` and ``logger`` are the parameters with which the nodes of the loop
    and the logger were found. CommissioningError if another client uses the machine.
    """

    def __init__(self, client: WaitingClient, values: Values, logger: Mapping[str, Any], folder: Path) -> None:
        self._client, self._values, self._folder = client, values, folder
        self._logger = {name: logger[name] for name in _RECORDING}
        self._travel = values["driver"][_TRAVEL]
        self._near = ARRIVED_M + 0.5 * node_parameters("driver", values).stage.encoder.x_resolution
        self.simulated = is_simulated(values["driver"])
        self._given: dict[str, dict[str, Any]] = {}
        if client.safety.amplifier_on:
            raise CommissioningError("the amplifier is on: another client uses the machine; stop that first")

    def listen(self, seconds: float) -> Series:
        """See `Machine`."""
        self._require_pace()
        self._prepare(self._in_open_loop(ExcitationParameters()))
        bag = self._folder / "bags" / "connection"
        with self._recorded(bag):
            end = time.monotonic() + seconds
            self._client.wait(lambda: time.monotonic() > end, seconds + _LATE_S, "time stood still")
        return recorded_series(bag)

    def play(self, excitation: ExcitationParameters) -> Series:
        """See `Machine`."""
        values = self._in_open_loop(excitation)
        self._prepare(values)
        bag = self._folder / "bags" / excitation.signal
        try:
            # In the driver: it switches off within a sample, and from the switch-on on.
            self._client.give("driver", {_TRAVEL: excitation.travel})
            with self._recorded(bag), self._switched_on():
                self._sleep(_CREEP_S)
                self._client.require(SetBool, "controller/excite", data=True)
                self._sleep(excitation.duration + _SETTLE_S)
        except LeftTravel:  # the series shows it; a step that may end so leaves no fault
            self._client.require(Trigger, "driver/reset_fault")
        finally:
            self._client.give("driver", {_TRAVEL: self._travel})
        self._rest()
        stage = node_parameters("controller", values).stage
        return excited(recorded_series(bag), excitation.travel, stage.rate)

    def stroke(self, values: Values, bag: Path, travel: float, count: int = 1) -> None:
        """See `Machine`."""
        self._prepare(values, error_limit=travel)
        motion = node_parameters("cell", values).stage.motion
        self._approach(motion)
        with self._recorded(bag), self._switched_on():
            self._sleep(_SETTLE_S)
            for _ in range(count):
                self._cycle(motion)
            self._sleep(_SETTLE_S)
        self._rest()

    def response(self, values: Values, excitation: MultisineParameters, *, moving: bool = False) -> ComparedResponse:
        """See `Machine`; with ``moving`` the stage makes strokes meanwhile, otherwise it stands where it is."""
        asked = {f"excitation.{name}": one for name, one in to_mapping(excitation).items()}
        # What is learned under a test signal is no correction of a stroke.
        asked |= {"excitation.signal": "multisine", "learning.learn": False}
        values = with_values(values, "controller", asked)
        nodes = node_parameters("controller", values)
        self._prepare(values, error_limit=2.0 * excitation.travel)
        bag, duration = self._folder / "bags" / "frequency_response", excitation.seconds + 2.0 * _SETTLE_S
        motion = nodes.stage.motion
        if moving:
            self._approach(motion)
        try:
            with self._recorded(bag), self._switched_on():
                self._sleep(2.0 * _SETTLE_S)
                self._client.require(SetBool, "controller/excite", data=True)
                why_ended = partial(self._why_ended, time.monotonic())
                end = time.monotonic() + duration
                while moving and time.monotonic() < end and not why_ended():
                    self._cycle(motion)
                self._sleep(max(0.0, end - time.monotonic()), why_ended)
                why = why_ended()
        except LeftTravel as error:
            raise ExcitationEnded(str(error), recorded_reading(bag)) from error
        self._rest()
        try:
            return response_from_bag(bag, excitation, nodes.control, nodes.stage)
        except ExcitationEnded as error:
            text = f"{error}; the controller: {why}" if why else str(error)
            raise ExcitationEnded(text, recorded_reading(bag, excitation.travel)) from error

    def _why_ended(self, begin: float) -> str:
        """Why the excitation ended early that began at ``begin``; empty while it goes on, and if it finished."""
        state = self._client.reports().get("controller", {}).get(EXCITATION, EXCITING)
        reported = time.monotonic() > begin + _REPORTED_S
        return state if reported and state not in (EXCITING, FINISHED) else ""

    def release(self) -> None:
        """Leave the loop inactive and the logger unconfigured, all with the parameters with which they were found, even
        if no samples come any more."""
        with ExitStack() as last:  # each, whatever becomes of the others; the last one first
            # It begins its next bag when it is configured.
            last.callback(self._client.give, "logger", self._logger)
            last.callback(self._client.bring, "logger", "unconfigured")
            last.callback(self._rest)
            self._configure(self._values)

    def _rest(self) -> None:
        """Make the loop inactive: what is computed next needs the processor, the loop's CPU too."""
        with ExitStack() as each:  # whatever becomes of the others; the last one first
            each.callback(use_kept_free, True)
            for node in ("driver", "feedforward", "controller"):
                each.callback(self._client.bring, node, "inactive")

    def _in_open_loop(self, excitation: ExcitationParameters) -> Values:
        asked = {f"excitation.{name}": one for name, one in to_mapping(excitation).items()}
        # What was learned is of another law.
        return with_values(self._values, "controller", {"control.law": OPEN_LOOP, "learning.learn": False, **asked})

    def _prepare(self, values: Values, **controller: Any) -> None:
        """Bring the loop to work with these parameters, the amplifier off."""
        use_kept_free(False)
        self._configure(with_values(values, "controller", controller))
        self._client.bring("driver", "active")
        self._client.wait(lambda: self._client.observation().fresh, _START_S, "no samples come from the driver")

    def _configure(self, values: Values) -> None:
        self._give("feedforward", values)
        self._give("controller", values)
        # A client that was killed may have left another.
        self._client.give("driver", {_TRAVEL: self._travel})

    def _give(self, node: str, values: Values) -> None:
        client = self._client
        wanted = to_mapping(node_parameters(node, values))
        wanted = {name: value for name, value in wanted.items() if not name.startswith(_AT_START)}
        given = self._given.get(node, {})
        changed = {name: value for name, value in wanted.items() if name not in given or given[name] != value}
        if not all(name.startswith(_AT_ONCE) for name in changed):
            client.bring(node, "unconfigured")
        if changed:
            # Until the answer it is not known what the node has.
            self._given.pop(node, None)
            client.give(node, changed)
        client.bring(node, "active")
        self._given[node] = wanted

    def _approach(self, motion: MotionParameters) -> None:
        """Move the stage to where its cycle begins, the amplifier off."""
        self._require_pace()
        client = self._client
        x = client.observation().x
        if not abs(x - motion.start) > AT_START_M:
            return
        points = jog(motion, x, motion.start - x)
        client.wait(lambda: client.stage_listens, _START_S, "no node subscribes to the stage's trajectory")
        client.move(points)
        self._arrive(motion.start, points[-1].time_ns * 1e-9 + _LATE_S)

    def _arrive(self, start: float, within: float) -> None:
        client = self._client
        client.wait(
            lambda: client.stage.condition == "held" or abs(client.observation().x - start) <= self._near,
            within,
            f"the stage did not come to its start at {start:g} m",
        )
        self._require_pace()

    def _require_pace(self) -> None:
        """CommissioningError where the stage is held or slowed down, as its operator may have left it."""
        stage = self._client.stage
        if stage.condition == "held":
            raise CommissioningError("the stage is held: end its motion by driver/end_motion, or let it go on")
        if stage.override != 1.0:
            speed = f"the stage makes its strokes at {stage.override:.3g} of their speed"
            raise CommissioningError(f"{speed}: set the driver's parameter 'override' to 1.0")

    def _cycle(self, motion: MotionParameters) -> None:
        """Make one cycle. Each is a trajectory of its own: after an interrupt no further one begins."""
        waypoints, way = forward_and_back(motion), 0.0

        def look() -> None:
            nonlocal way
            way = max(way, abs(self._client.observation().x - motion.start))

        self._client.move(waypoints)
        self._sleep(waypoints[-1].time_ns * 1e-9, look)
        self._arrive(motion.start, _LATE_S)
        far = [point for point in waypoints if abs(point.position - motion.start) > 2.0 * self._near]
        # The client looks every now and then.
        if way <= self._near and far and far[-1].time_ns - far[0].time_ns > _SEEN_NS:
            raise CommissioningError(
                "the stage does not follow its trajectory: the driver's log says why; a real stage is moved by its own "
                "controller, which then follows the topic 'stage_trajectory'"
            )

    @contextmanager
    def _recorded(self, bag: Path) -> Iterator[None]:
        """Record to ``bag`` with a logger that is configured for it, so that it attaches the present parameters."""
        client = self._client
        shutil.rmtree(bag, ignore_errors=True)
        client.bring("logger", "unconfigured")
        # The logger may run in another folder than this process.
        client.give("logger", {"output": str(bag.resolve()), "record_at_start": True})
        client.bring("logger", "active")
        client.wait(lambda: not client.observation().unrecorded, _START_S, "the logger is not connected to all topics")
        try:
            yield
        finally:
            time.sleep(_AFTER_S)
            client.bring("logger", "unconfigured")

    @contextmanager
    def _switched_on(self) -> Iterator[None]:
        client = self._client
        client.require(Trigger, "driver/reset_fault")
        end = time.monotonic() + ANSWER_S
        # An interrupt may come after a request and before its answer.
        try:
            while not (answer := client.ask(SetBool, "driver/enable", data=True)).success:
                if time.monotonic() > end:
                    raise CommissioningError(f"the amplifier cannot be switched on: {answer.message}")
                time.sleep(_SETTLE_S)
            client.wait(
                lambda: client.safety.amplifier_on or bool(client.safety.fault),
                ANSWER_S,
                "the driver does not say that the amplifier is on",
            )
            yield
        finally:
            client.require(SetBool, "driver/enable", data=False)

    def _sleep(self, seconds: float, over: Callable[[], object] = lambda: False) -> None:
        """Wait, not longer than until it is ``over``; the amplifier must not go off meanwhile if it is on.

        Raises:
            LeftTravel: the platform left its reference.
            CommissioningError: the amplifier went off for another reason.
        """
        client = self._client
        on, end = client.safety.amplifier_on, time.monotonic() + seconds

        def off() -> bool:
            return bool(client.safety.fault) or (on and not client.safety.amplifier_on)

        client.wait(lambda: time.monotonic() > end or off() or bool(over()), seconds + _LATE_S, "time stood still")
        if off():
            reason = client.safety.fault or "another client switched it off"
            # The driver's own limit, if the controller's came too late.
            if client.safety.code in (Fault.FOLLOWING_ERROR.code, Fault.Y_OUT_OF_RANGE.code):
                raise LeftTravel(
                    f"{reason}; commands came late (straightcomp doctor says what delays this computer), or the "
                    "machine is not as described: look at the count of the encoder of y, at the platform, and at the "
                    "magnets"
                )
            raise CommissioningError(f"the amplifier went off: {reason}")


class Access(NamedTuple):
    """A machine, the parameters with which its nodes were found, and a function that reports what is done with it."""

    machine: RunningMachine
    values: Values
    report: Callable[[str], None]


@contextmanager
def running_graph(folder: Path, namespace: str = "", check: Callable[[], object] = lambda: None) -> Iterator[Access]:
    """The machine of the graph that runs, whose bags go to ``folder``; it is released at the end. CommissioningError if
    the graph cannot be used; ``check`` raises if it cannot work any more."""
    with WaitingClient(RECORDED, namespace, check) as client:
        # Before the nodes are asked: another client would have its own parameters in them.
        report = client.claim()
        first = FirstParameters(client.values(), client.processes())
        values = described(first.values)
        machine = RunningMachine(client, values, first.values["logger"], folder)
        first.keep()
        try:
            yield Access(machine, values, report)
        finally:
            # Whatever happened, the amplifier is off already.
            machine.release()
            first.forget()


@contextmanager
def started_graph(values: Values, folder: Path, *, emulated: bool = False) -> Iterator[Access]:
    """The machine of a graph that runs for this alone, with ``values`` by node and dotted name. It is simulated, or
    with ``emulated`` a board on a hub; ``folder`` gets bags, parameter file and logs. CommissioningError if a node does
    not start, or ended."""
    os.environ.update(isolated_environment())
    with _bus_folder(folder) as bus:
        if emulated:
            values = with_values(values, "driver", on_hub(values, str(bus / "bus")))
        parameter_file = folder / "parameters.yaml"
        write_whole(parameter_file, as_parameter_file(values))
        machine = emulated_machine(values, parameter_file)
        # Between processes a busy computer delays every command.
        nodes = (COMPOSED, "logger")
        try:
            with Graph(folder / "logs") as graph:
                for name, command in machine.items():
                    graph.start_program(name, command)
                for name in nodes:
                    graph.start(name, {"autostart": False}, parameter_file)
                with running_graph(folder, check=lambda: graph.check((*machine, *nodes))) as access:
                    yield access
        except LaunchError as error:
            raise CommissioningError(f"{error} (logs in {folder / 'logs'})") from error


@contextmanager
def _bus_folder(folder: Path) -> Iterator[Path]:
    """A place for the socket of a bus, the same for each run in ``folder``: it is a parameter of the nodes.

    The path of a socket has room for about a hundred characters: too few for some folders.
    """
    name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]
    bus = Path(tempfile.gettempdir()) / f"straightcomp_bus_{name}"
    try:
        make_private(bus)
    except OSError as error:
        raise CommissioningError(f"folder of the bus {bus}: {error.strerror}; remove it") from error
    try:
        yield bus
    finally:
        shutil.rmtree(bus, ignore_errors=True)


def described(parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters of the running loop as values with one description of the stage; CommissioningError if the nodes have
    different ones."""
    own = {
        node: {name: value for name, value in parameters[node].items() if not belongs_to_ros(name)}
        for node in IN_THE_LOOP
    }
    identities = {node: node_parameters(node, own).stage.identity for node in own}
    if len(set(identities.values())) > 1:
        found = ", ".join(f"{node} {identity}" for node, identity in identities.items())
        raise CommissioningError(
            f"the nodes' descriptions of the stage differ ({found}): start all with one stage file"
        )
    values = {
        node: {name: value for name, value in section.items() if not name.startswith("stage.")}
        for node, section in own.items()
    }
    return {**values, STAGE: under("stage.", own["controller"])}


class FirstParameters:
    """The parameters with which a client found the nodes, in files until the nodes have them again.

    There is a file for each node, named after its process: parameters of a node that was started anew are new. All
    clients of the user have the same folder, to which no other user may write.

    Attributes:
        values: by node and dotted name: those that a client which was killed has kept, otherwise those ``found``.
    """

    def __init__(self, found: Mapping[str, Mapping[str, Any]], processes: Mapping[str, str]) -> None:
        self._files = {
            node: private_folder() / f"parameters_{hashlib.sha256(process.encode()).hexdigest()[:24]}.json"
            for node, process in processes.items()
        }
        self.values = {node: dict(section) for node, section in found.items()}
        for node, file in self._files.items():
            with suppress(FileNotFoundError, ValueError):
                self.values[node] |= json.loads(file.read_text(encoding="utf-8"))

    def keep(self) -> None:
        """Write the files; call it before any parameter is changed."""
        for node, file in self._files.items():
            write_whole(file, json.dumps(self.values[node], default=list))

    def forget(self) -> None:
        """Remove the files; call it when the nodes have their first parameters again."""
        for file in self._files.values():
            file.unlink(missing_ok=True)
