"""From a roughly described stage to one that is measured, tuned and verified, in steps. No ROS."""


class CommissioningError(ValueError):
    """Commissioning cannot go on; the message says what was found, and what helps."""


class LeftTravel(CommissioningError):
    """The platform strayed from its reference; the amplifier was switched off."""
