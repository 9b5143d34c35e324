"""What follows from the description of a stage: figures that an engineer would compute by hand before the first run."""

import math
from dataclasses import dataclass

import numpy as np

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import Margins, loop_margins
from straightcomp_ros.hardware.can.budget import CLASSIC_1M, FD_1M_5M, load, traffic
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap

_GRID = 0.1e-3
"""m; far below the pitch of any survey."""
FLOOR_COUNTS = 1.1
"""Least p-p error in counts of the encoder that any law here with margins has left (docs/accuracy.md)."""


@dataclass(frozen=True)
class Consequences:
    """Figures of a stage and its law, SI units.

    Attributes:
        current_stiffness, position_stiffness: K̄_i in N/A and K̄_y in N/m, from (3).
        unstable_pole: √(K̄_y/M) of the platform in its magnets, 1/s.
        dead_time: T_d of the loop, s.
        dac_force, dac_displacement: of one step of the D/A converter: force in N, and in m against the bristles.
        breakaway_current: that overcomes static friction, A.
        holding_current: for friction, the magnets' pull at the largest correction, and its acceleration, A.
        correction: largest |r| over the stroke, m.
        reference_speed, reference_acceleration: largest |ṙ| in m/s and |r̈| in m/s² of a stroke.
        encoder_floor: p-p error in m that the encoder's count leaves at best.
        margins: of the law, None if it has no linearisation at rest.
        can_load, can_fd_load: fractions of the time for which a bus of 1 Mbit/s, and of FD with 5 Mbit/s, is busy.
    """

    current_stiffness: float
    position_stiffness: float
    unstable_pole: float
    dead_time: float
    dac_force: float
    dac_displacement: float
    breakaway_current: float
    holding_current: float
    correction: float
    reference_speed: float
    reference_acceleration: float
    encoder_floor: float
    margins: Margins | None
    can_load: float
    can_fd_load: float

    @property
    def difficulty(self) -> float:
        """Unstable pole times dead time: below some 0.5 gains with margins exist, at 0.65 none do."""
        return self.unstable_pole * self.dead_time


def consequences(stage: StageParameters, control: ControlParameters, straightness: StraightnessMap) -> Consequences:
    """The figures of ``stage`` with the law of ``control`` and the map of its guide."""
    actuator, friction, motion = stage.actuator, stage.friction, stage.motion
    x = motion.start + np.arange(0.0, motion.stroke + _GRID, _GRID)
    r, slope, curvature = (np.abs(values).max() for values in straightness.evaluate(x))
    # At cruise, and at the ends of the ramps.
    acceleration = float(curvature) * motion.speed**2 + float(slope) * motion.acceleration
    force = (
        friction.static
        + friction.viscous * float(slope) * motion.speed
        + actuator.position_stiffness * float(r)
        + stage.platform.mass * acceleration
    )
    dac_force = stage.drive.current_step * actuator.current_stiffness
    return Consequences(
        current_stiffness=actuator.current_stiffness,
        position_stiffness=actuator.position_stiffness,
        unstable_pole=math.sqrt(actuator.position_stiffness / stage.platform.mass),
        dead_time=stage.dead_time,
        dac_force=dac_force,
        dac_displacement=dac_force / friction.bristle_stiffness,
        breakaway_current=friction.static / actuator.current_stiffness,
        holding_current=force / actuator.current_stiffness,
        correction=float(r),
        reference_speed=float(slope) * motion.speed,
        reference_acceleration=acceleration,
        encoder_floor=FLOOR_COUNTS * stage.encoder.y_resolution,
        margins=_margins(stage, control),
        can_load=load(traffic(CanParameters(fd=False).make_wire(), stage.rate), CLASSIC_1M),
        can_fd_load=load(traffic(CanParameters(fd=True).make_wire(), stage.rate), FD_1M_5M),
    )


def _margins(stage: StageParameters, control: ControlParameters) -> Margins | None:
    try:
        return loop_margins(make_law(control, stage), stage)
    except ValueError:
        return None
