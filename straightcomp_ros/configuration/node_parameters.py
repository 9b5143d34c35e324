"""The parameters of every node."""

from __future__ import annotations

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
        True, "Configure and activate at the start; false leaves that to whoever manages lifecycle nodes"
    )
    return declared


@dataclass(frozen=True)
class DriverNodeParameters:
    """Parameters of the node `driver`."""

    dynamic: ClassVar[tuple[str, ...]] = ("current_limit",)
    """Parameters and groups that may be changed while the node is configured."""

    autostart: bool = _autostart()
    hardware: str = parameter("simulated", "Backend", choices=("simulated", "can"))
    current_limit: float = parameter(
        1.0,
        "A command beyond ± this switches the amplifier off and latches a fault",
        unit="A",
        above=0.0,
        maximum=100.0,
    )
    lockstep: bool = parameter(
        False, "Advance the simulated machine only when the command for its last sample came, instead of in real time"
    )
    lockstep_delay: float = parameter(
        0.5,
        "In lockstep: command delay from the sample, in sampling periods",
        unit="samples",
        minimum=0.0,
        maximum=10.0,
    )
    simulated: SimulatedParameters = group(SimulatedParameters)
    guide: MapParameters = group(MapParameters, file="config/guide_synthetic.csv")
    can: CanParameters = group(CanParameters)
    watch: WatchParameters = group(WatchParameters)
    realtime: RealtimeParameters = group(RealtimeParameters)

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
    map: MapParameters = group(MapParameters)
    feedforward: FeedforwardParameters = group(FeedforwardParameters)
    interval: float = parameter(
        0.002, "Time between two looks for samples; all that came are answered then", unit="s", above=0.0, maximum=0.01
    )
    realtime: RealtimeParameters = group(RealtimeParameters)


@dataclass(frozen=True)
class ControllerNodeParameters:
    """Parameters of the node `controller`."""

    dynamic: ClassVar[tuple[str, ...]] = ("control",)
    """Parameters and groups that may be changed while the node is configured."""

    autostart: bool = _autostart()
    rate: int = parameter(DEFAULT_RATE, "Control cycles per second", unit="Hz", minimum=10, maximum=20_000)
    trigger: str = parameter(
        "sample",
        "What begins a control cycle. sample: the arrival of an encoder sample. timer: a timer at 'rate'; each cycle "
        "answers all samples that came since the last. lockstep: as sample, but each sample waits for its own "
        "reference, for a driver in lockstep or a replay",
        choices=("sample", "timer", "lockstep"),
    )
    reference_lead: int = parameter(
        12,
        "A sample is served by the reference of so many samples before, extrapolated",
        unit="samples",
        minimum=0,
        maximum=100,
    )
    sample_timeout: float = parameter(
        1.0, "Silence of the encoder after which the driver is asked to switch off", unit="s", above=0.0, maximum=60.0
    )
    control: ControlParameters = group(ControlParameters)
    learning: LearningParameters = group(LearningParameters)
    realtime: RealtimeParameters = group(RealtimeParameters)

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
    output: str = parameter("", "Folder of the bag; empty makes one named after the time of the start")
    compression: str = parameter("zstd", "Compression of the bag's chunks", choices=("zstd", "lz4", "none"))
    queue_depth: int = parameter(
        8000, "Messages of each topic that may wait in the middleware while this process is held up", minimum=1
    )
    queue_limit: int = parameter(
        200_000, "Messages in memory that wait for the disk; beyond it they are dropped and counted", minimum=1000
    )
    topics: str = parameter(
        ".*", "Regular expression that a topic's name must match as a whole to be recorded, e.g. 'encoder|command'"
    )
    other_topics: str = parameter(
        "",
        "Regular expression that full names of further topics must match as a whole, of any type, e.g. "
        "'/displacement|/rosout'; empty for none",
    )
    record_at_start: bool = parameter(True, "Record from the start on; otherwise from ~/start on")
    max_file_bytes: int = parameter(
        0, "Size of a file from which the bag goes on in another; 0 for one file", unit="byte", minimum=0
    )
    max_file_duration: float = parameter(
        0.0,
        "Time from a file's first message after which the bag goes on in another; 0 for one file",
        unit="s",
        minimum=0.0,
    )
    snapshot: float = parameter(
        0.0,
        "0 records all; otherwise the last so many seconds stay in memory until ~/snapshot is called",
        unit="s",
        minimum=0.0,
        maximum=600.0,
    )
    min_free_bytes: int = parameter(
        200_000_000, "Free space on the disk below which the recording is finished and the node fails", minimum=0
    )
    nodes: str = parameter(
        "driver feedforward controller", "Nodes whose parameters are attached to the bag, separated by blanks"
    )
    realtime: RealtimeParameters = group(RealtimeParameters)


@dataclass(frozen=True)
class CellNodeParameters:
    """Parameters of the node `cell`."""

    nodes: str = parameter("driver feedforward controller logger", "Nodes that must be there, separated by blanks")
    start_timeout: float = parameter(30.0, "Longest wait for the nodes, and for the amplifier", unit="s", above=0.0)
    sample_timeout: float = parameter(2.0, "Silence of the encoder that ends the run", unit="s", above=0.0)
    heartbeat_timeout: float = parameter(
        3.0, "Silence of a node that ends the run", unit="s", minimum=0.5, maximum=60.0
    )
    strokes: int = parameter(1, "Strokes forward and back", minimum=1, maximum=1000)
    home: bool = parameter(
        False, "First bring the platform to the middle of its travel, then onto the map; takes some 2 s"
    )
    recoveries: int = parameter(
        0, "Faults after which the amplifier is switched on again in mid-cycle; one more ends the run", minimum=0
    )
    progress: bool = parameter(False, "Print a line 'progress FRACTION' on standard output as the stage moves")
    motion: MotionParameters = group(MotionParameters)
    realtime: RealtimeParameters = group(RealtimeParameters)


@dataclass(frozen=True)
class PlayerNodeParameters:
    """Parameters of the node `player`."""

    bag: str = parameter("", "Bag whose samples are published: a rosbag2 folder or MCAP file")
    topic: str = parameter("encoder", "The bag's name for the topic of the samples")
    speed: float = parameter(1.0, "Speed of the play, 1 as recorded", above=0.0, maximum=100.0)
    subscribers: int = parameter(2, "Subscribers of the samples that the play waits for", minimum=0, maximum=100)
    start_timeout: float = parameter(30.0, "Longest wait for them", unit="s", above=0.0)
    ahead: int = parameter(
        0,
        "Samples without a command beyond which the play waits, so that slow nodes lose none; 0 keeps the pace",
        unit="samples",
        minimum=0,
        maximum=500,
    )
    clock: bool = parameter(False, "Publish the time of the samples on /clock, for nodes with use_sim_time")
    realtime: RealtimeParameters = group(RealtimeParameters)


@dataclass(frozen=True)
class OpcuaNodeParameters:
    """Parameters of the node `opcua`."""

    nodes: str = parameter("driver feedforward controller logger", "Nodes that must work, separated by blanks")
    start_timeout: float = parameter(
        30.0, "Longest wait for the nodes, for the amplifier, and for a fault to be cleared", unit="s", above=0.0
    )
    error_limit: float = parameter(
        2e-6, "Peak-to-peak error of a movement of the stage above which there is an alarm", unit="m", above=0.0
    )
    opcua: OpcuaParameters = group(OpcuaParameters)
    motion: MotionParameters = group(MotionParameters)
    realtime: RealtimeParameters = group(RealtimeParameters)


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
        ParameterError: a name is unknown or a value refused; the message names the node too.
    """
    try:
        return from_mapping(NODE_PARAMETERS[name], values)
    except ParameterError as error:
        raise ParameterError(f"node {name}: {error}") from error
