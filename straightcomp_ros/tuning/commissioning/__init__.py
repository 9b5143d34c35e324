"""From a roughly described stage to one that is measured, tuned and verified, in steps. No ROS."""

STEP_NAMES = (
    "connection",
    "signs_and_scales",
    "safe_loop",
    "identification",
    "design",
    "frequency_response",
    "acceptance",
    "certificate",
)
"""The steps in their order. Here, since the steps themselves import all of the design."""


class CommissioningError(ValueError):
    """Commissioning cannot go on; the message says what was found, and what helps."""


class LeftTravel(CommissioningError):
    """The platform strayed from its reference; the amplifier was switched off."""
