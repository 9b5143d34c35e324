"""The parameters of every node."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.control.learning import LearningParameters
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames import CURRENT_COUNT, CURRENT_LIMIT
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.stage import MotionParameters
from straightcomp_ros.opcua.gateway_parameters import OpcuaParameters
from straightcomp_ros.safety.watch import WatchParameters
from straightcomp_ros.settings.declaration import ParameterError, RefusedParameter, from_mapping, group, parameter
from straightcomp_ros.straightness.feedforward import FeedforwardParameters
from straightcomp_ros.straightness.guide_map import MapParameters
from straightcomp_ros.timing.realtime import RealtimeParameters


def _autostart() -> bool:
    declared: bool = parameter(
        True, "Configure and activate the node when it starts; false leaves that to a lifecycle manager"
    )
    return declared


@dataclass(frozen=True)
class DriverNodeParameters:
    """Parameters of the node `driver`."""

    dynamic: ClassVar[tuple[str, ...]] = ("current_limit",)
    """Parameters and groups that may be changed while the node is configured."""

    autostart: bool = _autostart()
    hardware: str = parameter(
        "simulated", "Machine: simulated in the driver, or a board on CAN", choices=("simulated", "can")
    )
    current_limit: float = parameter(
        1.0,
        "Largest magnitude of a commanded control current; beyond it the amplifier is switched off and a fault latched",
        "(0, 100] A",
    )
    lockstep: bool = parameter(
        False, "Advance the simulated machine only when the command for its last sample has arrived, not in real time"
    )
    lockstep_delay: float = parameter(
        0.5, "Time from a sample until its command takes effect while 'lockstep' is true", "[0, 10] samples"
    )
    simulated: SimulatedParameters = group(SimulatedParameters, "Simulated board")
    guide: MapParameters = group(MapParameters, "Simulated guide", file="config/guide_synthetic.csv")
    can: CanParameters = group(CanParameters, "CAN board")
    watch: WatchParameters = group(WatchParameters, "Fault detection")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")

    def __post_init__(self) -> None:
        if self.hardware != "can":
            return
        if self.lockstep:
            raise RefusedParameter(
                "lockstep", "True needs a simulated machine; allowed: false ('{group}hardware' is 'can')"
            )
        largest = CURRENT_LIMIT * CURRENT_COUNT
        if self.current_limit > largest:
            raise RefusedParameter(
                "current_limit", f"{self.current_limit!r} A is too large for CAN; allowed: <= {largest:g} A"
            )

    @property
    def machine(self) -> SimulatedParameters | CanParameters:
        """Parameters of the backend that ``hardware`` names."""
        return self.can if self.hardware == "can" else self.simulated


@dataclass(frozen=True)
class FeedforwardNodeParameters:
    """Parameters of the node `feedforward`."""

    dynamic: ClassVar[tuple[str, ...]] = ("map",)
    """Parameters and groups that may be changed while the node is configured."""

    autostart: bool = _autostart()
    map: MapParameters = group(MapParameters, "Map of the guide")
    feedforward: FeedforwardParameters = group(FeedforwardParameters, "Tracking of the stage")
    interval: float = parameter(
        0.002, "Time between two cycles; each answers all samples since the last", "(0, 0.01] s"
    )
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")


@dataclass(frozen=True)
class ControllerNodeParameters:
    """Parameters of the node `controller`."""

    dynamic: ClassVar[tuple[str, ...]] = ("control",)
    """Parameters and groups that may be changed while the node is configured."""

    autostart: bool = _autostart()
    rate: int = parameter(DEFAULT_RATE, "Control cycles per second", "[10, 20000] Hz")
    trigger: str = parameter(
        "sample",
        "What begins a control cycle. sample: the arrival of an encoder sample. timer: a timer at 'rate'; each cycle "
        "answers all samples that arrived since the last. lockstep: as sample, but each sample waits for its own "
        "reference, for a driver in lockstep or a replay",
        choices=("sample", "timer", "lockstep"),
    )
    reference_lead: int = parameter(
        12,
        "Age of a sample's reference, in samples; the controller extrapolates it to the sample's time",
        "[0, 100] samples",
    )
    sample_timeout: float = parameter(
        1.0, "Time without a sample after which the driver is asked to switch off", "(0, 60] s"
    )
    control: ControlParameters = group(ControlParameters)
    learning: LearningParameters = group(LearningParameters, "Learned correction")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")

    @property
    def lead_ns(self) -> int:
        """``reference_lead`` in ns at this rate."""
        return round(self.reference_lead * 1e9 / self.rate)


@dataclass(frozen=True)
class LoggerNodeParameters:
    """Parameters of the node `logger`."""

    dynamic: ClassVar[tuple[str, ...]] = ("min_free_bytes",)
    """Parameters and groups that may be changed while the node is configured."""

    autostart: bool = _autostart()
    output: str = parameter("", "Folder of the bag; empty: a new one, named after the start time")
    compression: str = parameter("zstd", "Compression of the bag's chunks", choices=("zstd", "lz4", "none"))
    queue_depth: int = parameter(
        8000, "Messages of each topic that may wait in the middleware while the logger is held up", "[1, inf)"
    )
    queue_limit: int = parameter(
        200_000, "Messages that may wait in memory for the disk; further ones are dropped and counted", "[1000, inf)"
    )
    topics: str = parameter(
        ".*", "Regular expression for the whole names of this package's topics to record, e.g. 'encoder|command'"
    )
    other_topics: str = parameter(
        "",
        "Regular expression for the whole full names of further topics to record, of any type, e.g. "
        "'/displacement|/rosout'; empty for none",
    )
    record_at_start: bool = parameter(True, "Record from the node's start on; false: from the service ~/start on")
    max_file_bytes: int = parameter(
        0, "Size of a file at which the bag continues in a new one; 0 for one file", "[0, inf) byte"
    )
    max_file_duration: float = parameter(
        0.0,
        "Time from a file's first message after which the bag continues in a new file; 0 for one file",
        "[0, inf) s",
    )
    snapshot: float = parameter(
        0.0,
        "Length of the recording that stays in memory until the service ~/snapshot writes it; 0 writes all at once",
        "[0, 600] s",
    )
    min_free_bytes: int = parameter(
        200_000_000, "Free bytes on the disk below which the logger finishes the bag and fails", "[0, inf)"
    )
    nodes: str = parameter(
        "driver feedforward controller", "Nodes whose parameters are attached to the bag, separated by blanks"
    )
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")


@dataclass(frozen=True)
class CellNodeParameters:
    """Parameters of the node `cell`."""

    nodes: str = parameter(
        "driver feedforward controller logger", "Nodes to wait for and to watch, separated by blanks"
    )
    start_timeout: float = parameter(30.0, "Longest wait for the nodes, and for the amplifier", "(0, inf) s")
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
    motion: MotionParameters = group(MotionParameters, "Strokes of the stage")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")


@dataclass(frozen=True)
class PlayerNodeParameters:
    """Parameters of the node `player`."""

    bag: str = parameter("", "Bag whose encoder samples are played: a rosbag2 folder or MCAP file")
    topic: str = parameter("encoder", "Name of the topic with the encoder samples in the bag")
    speed: float = parameter(1.0, "Speed of the playback; 1 is as recorded", "(0, 100]")
    subscribers: int = parameter(2, "Subscribers of the samples that the player waits for", "[0, 100]")
    start_timeout: float = parameter(30.0, "Longest wait for the subscribers", "(0, inf) s")
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
        30.0, "Longest wait for the nodes, for the amplifier, and for a fault to be cleared", "(0, inf) s"
    )
    error_limit: float = parameter(
        2e-6, "Peak-to-peak error of one motion of the stage above which there is an alarm", "(0, inf) m"
    )
    opcua: OpcuaParameters = group(OpcuaParameters, "OPC UA server")
    motion: MotionParameters = group(MotionParameters, "Strokes of the stage")
    realtime: RealtimeParameters = group(RealtimeParameters, "Scheduling of this node")


NODE_PARAMETERS: Mapping[str, type] = {
    "driver": DriverNodeParameters,
    "feedforward": FeedforwardNodeParameters,
    "controller": ControllerNodeParameters,
    "logger": LoggerNodeParameters,
    "cell": CellNodeParameters,
    "player": PlayerNodeParameters,
    "opcua": OpcuaNodeParameters,
}
"""Parameter set of each node, by the node's name."""


def node_parameters(name: str, values: Mapping[str, Any]) -> Any:
    """Validated parameter set of the node ``name``.

    Raises:
        ParameterError: a name is unknown or a value is refused; the message also names the node.
    """
    try:
        return from_mapping(NODE_PARAMETERS[name], values)
    except ParameterError as error:
        raise ParameterError(f"node {name}: {error}") from error
