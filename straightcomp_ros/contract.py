"""The interface between the nodes: topics, joint names, columns. This is their only definition.

All numbers are SI (m, s, A, N). Every stream carries the stamp of the encoder sample that it belongs to. The stamp
identifies the sample, so a command can be traced to its sample.
"""

from dataclasses import dataclass

from straightcomp_ros.messages.cdr import Layout, joint_state, joint_trajectory_point

STAGE = "stage_x"
PLATFORM = "platform_y"
STROKE = 1.760
"""Length of the stage's travel in m."""
DEFAULT_RATE = 2000
"""Control cycles per second."""


@dataclass(frozen=True)
class Stream:
    """A topic at the control rate, with the layout of its messages."""

    topic: str
    layout: Layout
    description: str

    @property
    def batch_topic(self) -> str:
        """Topic of the batches of a stream in :data:`STREAMS`."""
        return f"{self.topic}_batches"


def _variables(names: str) -> Layout:
    """Layout of a record of numbers, whose names stand in place of the joints'."""
    return joint_state(names.split(), position=names.split())


ENCODER = Stream(
    "encoder",
    joint_state([STAGE, PLATFORM], position=["x", "y"], effort=["stage_effort", "coil_current"]),
    "Sample of both encoders in m. Effort: NaN for the stage, measured control current of the coils in A for the "
    "platform, NaN while the amplifier is off.",
)
REFERENCE = Stream(
    "reference",
    joint_trajectory_point(PLATFORM, position="r", velocity="r_dot", acceleration="r_ddot"),
    "Where the platform must be for the sample's x: r in m, its rate in m/s, its acceleration in m/s².",
)
COMMAND = Stream(
    "command",
    joint_state([PLATFORM], effort=["control_current"]),
    "Control current i_c in A, with the stamp of the sample that it was computed from.",
)
CONTROLLER_STATE = Stream(
    "controller_state",
    _variables(
        "error sliding_variable equivalent_current switching_current velocity_estimate disturbance_estimate "
        "reference_age"
    ),
    "Inner variables of the control law: error in m, sliding variable in m/s, the two parts of the control current "
    "in A, velocity estimate in m/s, disturbance estimate in m/s² (NaN if the law has none), age of the reference "
    "in s: stamp of the sample minus stamp of its reference.",
)
DRIVER_STATE = Stream(
    "driver_state",
    _variables("command_latency lateness applied_current enabled"),
    "The driver's record of each sample: time from the newest command's sample until that command arrived, s (NaN if "
    "none arrived since the last sample); time from this sample until it was published, s; control current requested "
    "from the amplifier, A; amplifier on (1) or off (0).",
)
TRUTH = Stream(
    "truth",
    _variables("true_x true_y true_y_dot friction_force magnetic_force guide_deviation"),
    "Simulation only: the plant's true state at the sample: m, m/s, N, and the guide's deviation δ(x) in m.",
)
ALWAYS_PUBLISHED = (ENCODER, REFERENCE, COMMAND, CONTROLLER_STATE, DRIVER_STATE)
"""Streams that every graph publishes."""
STREAMS = (*ALWAYS_PUBLISHED, TRUTH)
"""Each is also published in batches, for subscribers that can wait; see :mod:`straightcomp_ros.messages.cdr`."""

DISPLACEMENT = Stream(
    "displacement",
    joint_state(["displacement"], position=["deviation"]),
    "Surveys only: reading in m of a displacement sensor on the slider that measures against a straight edge. A "
    "separate node publishes it; the logger records it, and no other node of this package needs it.",
)

POSITION = Stream(
    "position",
    joint_state([STAGE, PLATFORM], position=["x", "y"]),
    "Every twentieth sample of both encoders in m, for nodes that only watch. Not recorded.",
)
POSITION_EVERY = 20
"""Samples per message of ``position``; in lockstep every sample has one."""

CLOCK = "/clock"
"""rosgraph_msgs/Clock, published by the player if its parameter `clock` is true: time of the played samples."""
STAGE_TRAJECTORY = "stage_trajectory"
"""trajectory_msgs/JointTrajectory: requested motion of the stage (joint `stage_x`)."""
STAGE_STATE = "stage_state"
"""diagnostic_msgs/DiagnosticStatus, latched, from the driver at each change: the condition of the stage's motion as
name (rest, moving, stopping, held); values `override`, `behind_ns` (how far the motion is behind its trajectory), `cut`
(whether it had another pace than 1 since it began), `number` (motions begun) and `ended` (whether the last one was
ended on its way)."""
DIAGNOSTICS = "/diagnostics"
"""diagnostic_msgs/DiagnosticArray, 1 Hz, from each node in any namespace; a status is named ``namespace/node``."""
UNCONNECTED = "unconnected"
"""Value in the logger's diagnostics: full names of the topics that no node publishes yet, separated by blanks."""
SAFETY_STATE = "safety_state"
"""diagnostic_msgs/DiagnosticStatus, latched, from the driver at each change: level, fault's name (empty without one),
message; values `condition` (off, on, fault), `code` (the fault's number, 0 without one) and `time_ns`, when the
condition began, ns since the epoch."""
TRIP = "trip"
"""diagnostic_msgs/DiagnosticStatus: makes the driver switch the amplifier off; name: the fault, message: the reason."""
HEARTBEAT = "heartbeat"
"""diagnostic_msgs/DiagnosticStatus, ten times a second from each lifecycle node: its name, and its state as message."""
COMMISSIONING_STATE = "commissioning_state"
"""diagnostic_msgs/DiagnosticStatus, latched, from the node `commissioning` when it begins or ends something: its name,
level, what was found, and a value `running`."""
COMMISSIONING_CLIENT = "commissioning_client"
"""diagnostic_msgs/DiagnosticStatus, latched, from a client that commissions the machine: what it does, as message. As
long as it lives (liveliness, 1 s), no cycle may run; when it is gone, the driver switches the amplifier off."""
