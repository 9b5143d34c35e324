"""The parameter set of each node, and how it is made of values by node: of files, the command line, a bag."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from straightcomp_ros.bags import RecorderParameters
from straightcomp_ros.control.excitation import ExcitationParameters
from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.control.learning import LearningParameters
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.plant import Hold, PlantParameters
from straightcomp_ros.opcua.admission import OpcuaParameters
from straightcomp_ros.parameters.declaration import ParameterError, RefusedParameter, from_mapping, group, parameter
from straightcomp_ros.safety.watch import WatchParameters
from straightcomp_ros.stage.description import StageParameters, true_guide, true_plant
from straightcomp_ros.straightness.feedforward import FeedforwardParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.timing.realtime import RealtimeParameters

_NODE = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def _check_nodes(names: str) -> None:
    for name in names.split():
        if not _NODE.fullmatch(name):
            raise RefusedParameter(
                "nodes", f"{name!r} is no name of a node; allowed: letters, digits, _ and /, and blanks between names"
            )


def _autostart() -> Any:
    return parameter(True, "Configure and activate the node when it starts; false leaves that to a lifecycle manager")


@dataclass(frozen=True)
class DriverNodeParameters:
    """Parameters of the node `driver`."""

    # Here and below: parameters and groups that may be changed while the node is configured.
    dynamic: ClassVar[tuple[str, ...]] = ("stage.actuator.current_limit", "watch.travel", "override", "blend")

    autostart: bool = _autostart()
    stage: StageParameters = group(StageParameters)
    hardware: str = parameter(
        "simulated", "Machine: simulated in the driver, or a board on CAN", choices=("simulated", "can")
    )
    lockstep: bool = parameter(
        False, "Advance the simulated machine only when the command for its last sample has arrived, not in real time"
    )
    override: float = parameter(
        1.0,
        "Fraction of the speed of the stage's motions, also of the present one: it changes its speed within its limits",
        "[0, 1]",
    )
    blend: bool = parameter(
        False,
        "A trajectory that comes while the stage moves takes the place of its motion, with continuous speed, if its "
        "first point comes later than 0 s; otherwise it is refused",
    )
    simulated: SimulatedParameters = group(SimulatedParameters, "Simulated board")
    can: CanParameters = group(CanParameters, "CAN board")
    watch: WatchParameters = group(WatchParameters, "Fault detection")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")

    def __post_init__(self) -> None:
        if self.lockstep and not self.simulated.referenced:
            raise RefusedParameter(
                "simulated.referenced", "False is not allowed with '{group}lockstep': no time passes for homing there"
            )
        if self.hardware != "can":
            return
        if self.lockstep:
            raise RefusedParameter(
                "lockstep", "True needs a simulated machine; allowed: false ('{group}hardware' is 'can')"
            )
        command, limit = self.can.make_wire().command, self.stage.actuator.current_limit
        largest = min(-command.spans["current"][0], command.spans["current"][1])
        if limit > largest:
            raise RefusedParameter(
                "stage.actuator.current_limit", f"{limit!r} A is too large for CAN; allowed: <= {largest:g} A"
            )

    @property
    def machine(self) -> SimulatedParameters | CanParameters:
        """Parameters of the backend that ``hardware`` names."""
        return self.can if self.hardware == "can" else self.simulated

    @property
    def plant(self) -> PlantParameters:
        """The simulated machine."""
        return true_plant(self.stage, self.simulated.truth)

    def guide(self) -> StraightnessMap:
        """The simulated guide; SurveyError if its survey is refused."""
        return true_guide(self.stage, self.simulated.truth)

    @property
    def hold(self) -> Hold:
        """How the simulated board holds the platform when commands are late."""
        return self.simulated.hold(self.stage)


@dataclass(frozen=True)
class FeedforwardNodeParameters:
    """Parameters of the node `feedforward`."""

    dynamic: ClassVar[tuple[str, ...]] = ("stage.guide",)

    autostart: bool = _autostart()
    stage: StageParameters = group(StageParameters)
    feedforward: FeedforwardParameters = group(FeedforwardParameters, "Tracking of the stage")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")


@dataclass(frozen=True)
class ControllerNodeParameters:
    """Parameters of the node `controller`."""

    dynamic: ClassVar[tuple[str, ...]] = ("control", "error_limit", "excitation", "stage.actuator.current_limit")

    autostart: bool = _autostart()
    stage: StageParameters = group(StageParameters)
    trigger: str = parameter(
        "sample",
        "What begins a control cycle. sample: the arrival of an encoder sample. timer: a timer at 'stage.rate'; each "
        "cycle answers all samples that arrived since the last. lockstep: as sample, but each sample waits for its own "
        "reference, for a driver in lockstep or a replay",
        choices=("sample", "timer", "lockstep"),
    )
    reference_lead: float = parameter(
        0.003,
        "Age of a sample's reference, which the controller extrapolates to the sample's time; the feedforward has so "
        "long to answer",
        "[0, 0.02] s",
    )
    sample_timeout: float = parameter(
        1.0, "Time without a sample after which the driver is asked to switch off", "(0, 60] s"
    )
    error_limit: float = parameter(
        0.1,
        "Largest |r − y|, once it was within it with the amplifier on; the driver is asked to switch off beyond it",
        "(0, 0.1] m",
    )
    control: ControlParameters = group(ControlParameters)
    excitation: ExcitationParameters = group(ExcitationParameters, "What the service ~/excite injects")
    learning: LearningParameters = group(LearningParameters, "Learned correction")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")

    def __post_init__(self) -> None:
        self.control.check(self.stage)

    @property
    def lead_ns(self) -> int:
        """``reference_lead`` in ns."""
        return round(self.reference_lead * 1e9)


@dataclass(frozen=True)
class LoggerNodeParameters(RecorderParameters):
    """Parameters of the node `logger`."""

    dynamic: ClassVar[tuple[str, ...]] = ("min_free_bytes",)

    autostart: bool = _autostart()
    queue_depth: int = parameter(
        8000, "Messages of each topic that may wait in the middleware while the logger is held up", "[1, inf)"
    )
    topics: str = parameter(
        ".*",
        "Regular expression for the whole names of this package's topics to record, e.g. 'encoder|command', among the "
        "streams at the control rate, 'displacement', 'stage_trajectory' and 'diagnostics'; empty for none",
    )
    other_topics: str = parameter(
        "",
        "Regular expression for the whole full names of further topics to record, of any type, e.g. "
        "'/probe|/rosout'; empty for none",
    )
    record_at_start: bool = parameter(True, "Record from the node's start on; false: from the service ~/start on")
    incidents: int = parameter(
        0,
        "Incidents that are kept beside the bag: at a latched fault its last minute is packed into one file with all "
        "that explains it, by `straightcomp incident`; the oldest is removed; 0: none",
        "[0, 1000]",
    )
    nodes: str = parameter(
        "driver feedforward controller", "Nodes whose parameters are attached to the bag, separated by blanks"
    )
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")

    def __post_init__(self) -> None:
        _check_nodes(self.nodes)


@dataclass(frozen=True)
class CellNodeParameters:
    """Parameters of the node `cell`."""

    nodes: str = parameter(
        "driver feedforward controller logger", "Nodes to wait for and to watch, separated by blanks"
    )
    start_timeout: float = parameter(
        30.0, "Longest wait for the nodes, except for one that is starting, and for the amplifier", "(0, inf) s"
    )
    sample_timeout: float = parameter(2.0, "Time without a sample that ends the run", "(0, inf) s")
    heartbeat_timeout: float = parameter(3.0, "Time without a heartbeat of a node that ends the run", "[0.5, 60] s")
    strokes: int = parameter(1, "Number of strokes, each forward and back", "[1, 1000]")
    home: bool = parameter(
        False, "Before the strokes move the platform to the middle of its travel, then to the map; takes some 2 s"
    )
    recoveries: int = parameter(
        0, "Faults in mid-cycle after which the cell switches the amplifier on again; one more ends the run", "[0, inf)"
    )
    progress: bool = parameter(False, "Print a line 'progress FRACTION' on standard output while the stage moves")
    stage: StageParameters = group(StageParameters)
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")

    def __post_init__(self) -> None:
        _check_nodes(self.nodes)


@dataclass(frozen=True)
class PlayerNodeParameters:
    """Parameters of the node `player`."""

    bag: str = parameter("", "Bag whose encoder samples are played: a rosbag2 folder or MCAP file")
    topic: str = parameter("encoder", "Name of the topic with the encoder samples in the bag")
    speed: float = parameter(1.0, "Speed of the playback; 1 is as recorded", "(0, 100]")
    subscribers: int = parameter(2, "Subscribers of the samples that the player waits for", "[0, 100]")
    start_timeout: float = parameter(
        30.0, "Longest wait for the subscribers, and for other publishers of the samples to end", "(0, inf) s"
    )
    ahead: int = parameter(
        0,
        "Samples without a command beyond which the player waits, so that slow nodes lose none; 0 never waits",
        "[0, 500] samples",
    )
    clock: bool = parameter(False, "Publish the time of the samples on /clock, for nodes with use_sim_time")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")


@dataclass(frozen=True)
class OpcuaNodeParameters:
    """Parameters of the node `opcua`."""

    nodes: str = parameter("driver feedforward controller logger", "Nodes that must be working, separated by blanks")
    start_timeout: float = parameter(
        30.0,
        "Longest wait for the nodes, except for one that is starting, for the amplifier, and for a fault to be cleared",
        "(0, inf) s",
    )
    error_limit: float = parameter(
        2e-6, "Peak-to-peak error of one motion of the stage above which there is an alarm", "(0, inf) m"
    )
    maintenance_file: str = parameter(
        "", "File of `straightcomp history advise`, whose advice is the alarm MaintenanceDue; empty: none"
    )
    opcua: OpcuaParameters = group(OpcuaParameters, "OPC UA server")
    stage: StageParameters = group(StageParameters)
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")

    def __post_init__(self) -> None:
        _check_nodes(self.nodes)


@dataclass(frozen=True)
class CommissioningNodeParameters:
    """Parameters of the node `commissioning`."""

    output: str = parameter("", "Folder of the record, the bags and the results; must be given")
    evaluations: int = parameter(200, "Candidates of the design", "[1, 100000]")
    machines: int = parameter(100, "Uncertain machines of the design's check", "[1, 100000]")
    learn: int = parameter(0, "Strokes from which the controller learns before the acceptance; 0 for none", "[0, 1000]")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")


NODE_PARAMETERS: Mapping[str, type] = {
    "driver": DriverNodeParameters,
    "feedforward": FeedforwardNodeParameters,
    "controller": ControllerNodeParameters,
    "logger": LoggerNodeParameters,
    "cell": CellNodeParameters,
    "player": PlayerNodeParameters,
    "opcua": OpcuaNodeParameters,
    "commissioning": CommissioningNodeParameters,
}
"""Parameter set of each node, by the node's name."""

STAGE = "stage"
"""Key of the stage's description in values by node, which has the nodes' names otherwise."""
Values = Mapping[str, Mapping[str, Any]]
"""Parameters by node and dotted name; the description of the stage under :data:`STAGE`."""


def _described(name: str, values: Values) -> dict[str, Any]:
    """The description's parameters as the node ``name`` calls them; none for a node that has no description."""
    if STAGE not in NODE_PARAMETERS[name].__annotations__:
        return {}
    return {f"{STAGE}.{key}": value for key, value in values.get(STAGE, {}).items()}


def changed(values: Values, changes: Values) -> dict[str, dict[str, Any]]:
    """A copy of ``values`` with these changes of its nodes; a changed fact of the stage is that of every node."""
    facts = [f"{STAGE}.{name}" for name in changes.get(STAGE, {})]
    return {
        node: {name: value for name, value in section.items() if name not in facts} | {**changes.get(node, {})}
        for node, section in {STAGE: {}, **values}.items()
    }


def by_node(values: Values) -> dict[str, dict[str, Any]]:
    """Values of each node alone, the stage's description included, as a running node has them."""
    return {node: {**_described(node, values), **values.get(node, {})} for node in NODE_PARAMETERS if node in values}


def node_parameters(name: str, values: Values) -> Any:
    """Validated parameter set of the node ``name``; values of :data:`STAGE` hold for every node that has not its own.

    Raises:
        ParameterError: a name is unknown or a value is refused; the message also names the node.
    """
    try:
        return from_mapping(NODE_PARAMETERS[name], {**_described(name, values), **values.get(name, {})})
    except ParameterError as error:
        # A fact of the description is no node's own.
        own = "" if str(error).startswith(f"parameter '{STAGE}.") else f"node {name}: "
        raise ParameterError(f"{own}{error}") from error
