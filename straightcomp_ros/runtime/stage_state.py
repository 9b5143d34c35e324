"""The messages on the topic `stage_state`."""

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from straightcomp_ros.model.paced_motion import StageState


def stage_state(message: DiagnosticStatus) -> StageState:
    """Read a message; what it lacks, or has wrong, is as without a motion."""
    values = {value.key: value.value for value in message.values}
    try:
        return StageState(
            message.name,
            float(values["override"]),
            int(values["behind_ns"]),
            values["cut"] == "true",
            int(values["number"]),
            values["ended"] == "true",
        )
    except (KeyError, ValueError):
        return StageState()


def stage_status(state: StageState, hardware_id: str) -> DiagnosticStatus:
    """A message."""
    words = {"stopping": "the stage comes to rest", "held": "the stage is held, and goes on when that is asked for"}
    _, *values = state._asdict().items()
    return DiagnosticStatus(
        level=DiagnosticStatus.OK,
        name=state.condition,
        message=words.get(state.condition, f"{state.condition}, speed {state.override:.0%}"),
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(one).lower()) for key, one in values],
    )
