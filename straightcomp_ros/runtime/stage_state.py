"""The topic `stage_state`: what the driver says of the stage's motion."""

from __future__ import annotations

from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from straightcomp_ros.model.paced_motion import PacedMotion


class StageState(NamedTuple):
    """Content of a message on `stage_state`; see :class:`PacedMotion`."""

    condition: str = "rest"
    override: float = 1.0
    behind_ns: int = 0
    cut: bool = False
    number: int = 0
    ended: bool = False

    @classmethod
    def of_motion(cls, motion: PacedMotion, period_ns: int) -> StageState:
        """The state of ``motion`` now; at rest if it ends within ``period_ns``, in which lockstep takes no sample."""
        condition, behind_ns = (motion.condition, motion.behind_ns) if motion.lasts(period_ns) else ("rest", 0)
        return cls(condition, motion.pace.override, behind_ns, motion.cut, motion.number, motion.ended)

    @classmethod
    def of(cls, message: DiagnosticStatus) -> StageState:
        """Read a message; what it lacks, or has wrong, is as without a motion."""
        values = {value.key: value.value for value in message.values}
        try:
            return cls(
                message.name,
                float(values["override"]),
                int(values["behind_ns"]),
                values["cut"] == "true",
                int(values["number"]),
                values["ended"] == "true",
            )
        except (KeyError, ValueError):
            return cls()

    def message(self, hardware_id: str) -> DiagnosticStatus:
        """A message for `stage_state`."""
        words = {"stopping": "the stage comes to rest", "held": "the stage is held, and goes on when that is asked for"}
        _, *values = self._asdict().items()
        return DiagnosticStatus(
            level=DiagnosticStatus.OK,
            name=self.condition,
            message=words.get(self.condition, f"{self.condition}, speed {self.override:.0%}"),
            hardware_id=hardware_id,
            values=[KeyValue(key=key, value=str(one).lower()) for key, one in values],
        )
