"""All faults: number, time within which they are latched, what they mean and what helps, reaction, and what ends them.

What is detected, and by which node, is in the table of ``docs/safety.md``.
"""

import enum
from typing import NamedTuple

_OFF = "amplifier off, fault latched"
_RESET = "`driver/reset_fault`, then `driver/enable`"


class Description(NamedTuple):
    code: int  # the same in all versions and never used again for another fault
    within_ms: float  # longest time until it is latched, on an undisturbed machine with default parameters
    means: str
    causes: str  # the likely ones
    remedy: str  # what to do before it is reset
    reaction: str = _OFF
    reset: str = _RESET


@enum.unique
class Fault(enum.Enum):
    """All faults."""

    COMMAND_NOT_FINITE = Description(
        1,
        2.0,
        "the controller sent no number",
        "NaN in a gain, a learned table or a law of your own",
        "`straightcomp replay BAG` shows the first such command; look at the last change of parameters",
    )
    COMMAND_OUT_OF_RANGE = Description(
        2,
        2.0,
        "a command beyond the current limit",
        "driver and controller have different `stage.actuator.current_limit`; another program publishes commands",
        "one description for all nodes",
    )
    COMMAND_TIMEOUT = Description(
        3,
        30.0,
        "no fresh command for too long",
        "controller or feedforward ended or stalled; a busy computer",
        "read the nodes' logs, and docs/realtime.md; a longer `simulated.command_timeout`, or for a board "
        "`can.command_timeout`, of which four times count",
    )
    TWO_CONTROLLERS = Description(
        4,
        10.0,
        "another program sends commands too",
        "a second controller, a replay or a test in the same namespace and domain",
        "`ros2 topic info -v command` names it; give each graph a domain or a namespace: docs/security.md",
    )
    SAMPLE_NOT_FINITE = Description(
        5,
        2.0,
        "an encoder reading is no number",
        "encoder interface, cable, decoding of the frame",
        "look at the encoder; `can.wire` and the DBC file",
    )
    X_JUMP = Description(
        6,
        2.0,
        "x moved faster than possible",
        "lost counts, a wrong resolution of x, a reset of the encoder",
        "look at cable and shielding; `stage.motion.highest_speed`, `stage.encoder.x_resolution`",
    )
    Y_OUT_OF_RANGE = Description(
        7,
        2.0,
        "the platform left its allowed range",
        "unstable loop, a push, commands that stopped",
        "as for the verdict `at_stop` (docs/troubleshooting.md); `watch.y_limit`",
    )
    Y_FROZEN = Description(
        8,
        500.0,
        "y does not change though the current does",
        "encoder dead, platform blocked or clamped at its stop",
        "move the platform by hand with the amplifier off, and watch y",
    )
    X_FROZEN = Description(
        9,
        1000.0,
        "x does not change though the stage was asked to move",
        "encoder of x dead, stage blocked, drive off",
        "look at the stage's drive and the encoder of x",
    )
    CLOCK_JUMP = Description(
        10,
        2.0,
        "the system's clock was stepped",
        "a time service that steps the clock",
        "let it slew (chrony), or step before the nodes start",
    )
    MAP_MISSING = Description(
        11,
        60.0,
        "x is beyond the survey and its run-out",
        "stroke too long, another zero of x",
        "shorten the stroke (`stage.motion.*`), or survey the whole guide",
    )
    SAMPLE_TIMEOUT = Description(
        12,
        1200.0,
        "no sample for too long",
        "the driver or the machine ended; cable or power of the board",
        "start the driver again; on CAN look at the state of the bus",
        "amplifier off (the board by itself, where the driver is gone), fault latched",
        "start the driver again; then as the others",
    )
    HEARTBEAT_LOST = Description(
        13,
        3200.0,
        "a node or the board is silent",
        "it ended, was stopped, or the bus is off",
        "read the node's log; `ip -details link show can0`",
        "board: amplifier off, fault latched; node: the cell ends its cycle with the amplifier off",
        "start the node again; for the board as the others",
    )
    BOARD = Description(
        14,
        10.0,
        "the board reports a fault, restarted, or does not switch on or off",
        "the board's own monitoring; its supply; a contactor that is welded",
        "the reason has the board's code: docs/can.md",
    )
    TRIPPED = Description(
        15, 60.0, "a message on `trip`", "an operator or another node asked for it", "the reason says who and why"
    )
    RECORDING_STOPPED = Description(
        16,
        5000.0,
        "the bag cannot be written",
        "disk full, folder not writable",
        "free space (`min_free_bytes`), start the logger again with another folder",
        "the bag is finished, the logger fails (the time is until its process has ended); the loop goes on",
        "free space; start the logger again, with another folder",
    )
    FOLLOWING_ERROR = Description(
        17,
        60.0,
        "the platform is too far from its reference",
        "gains that do not fit, a push, a load; at commissioning a wrong description",
        "as for the verdicts `oscillates` and `inaccurate` (docs/troubleshooting.md); `error_limit`, `watch.travel`",
    )
    CLIENT_GONE = Description(
        18,
        1200.0,
        "the client that commissions the machine ended",
        "it was killed or suspended",
        "start it again: it goes on with the step that is next",
    )
    NOT_REFERENCED = Description(
        19,
        10.0,
        "x is not counted from its reference",
        "a power cycle, a lost index, a counter that wraps",
        "reference x with the stage's controller; a simulated one: `driver/home`",
        reset="reference x; then as the others",
    )

    @property
    def label(self) -> str:
        """The name in messages, logs and documents, such as ``x_jump``."""
        return self.name.lower()

    @property
    def code(self) -> int:
        """The number; 0 is no fault."""
        return self.value.code


LABELLED = {fault.label: fault for fault in Fault}
"""All faults by the names that messages have."""


def explained(text: str) -> dict[str, str]:
    """What to show of a fault, from the ``text`` of a message, which begins with its label: its words, what it means,
    its causes, and what to do; these are empty where it is none of ours."""
    label = text.removeprefix("fault ").partition(":")[0].strip()
    shown = {"text": text, "means": "", "causes": "", "remedy": ""}
    if label in LABELLED:
        found = LABELLED[label].value
        remedy = f"{found.remedy}. Then: {found.reset.replace('as the others', _RESET)}"
        shown |= {"means": found.means, "causes": found.causes, "remedy": remedy}
    return shown


LONGEST_REASON = 500
"""Characters of a reason that another node gives: it is logged, published and shown."""


def one_line(text: str, longest: int = LONGEST_REASON) -> str:
    """At most the ``longest`` first characters of another program's text, those that steer a terminal or end a line as
    escapes such as ``\\x1b``."""
    shown = (one if one.isprintable() else one.encode("unicode_escape").decode() for one in text[:longest])
    return "".join(shown)[:longest]


Finding = tuple[Fault, str]
"""A fault, and the reason in words."""
