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
LOOP, LIMITS, STROKE, LEARNED = "loop.png", "limits.yaml", "stroke.png", "learned.csv"
PAGE, FIGURES, TUNED = "certificate.html", "certificate.json", "tuned.yaml"
STEP_FILES = {
    "frequency_response": (LOOP,),
    "acceptance": (LIMITS, STROKE, LEARNED),
    "certificate": (PAGE, FIGURES, TUNED),
}
"""The files in the folder of a commission, by the step that writes them."""
RECORD = "commission.json"
MADE = (RECORD, "bags", "logs", "parameters.yaml", *(name for names in STEP_FILES.values() for name in names))
"""All of them."""


class CommissioningError(ValueError):
    """Commissioning cannot go on; the message says what was found, and what helps."""


class CommissionRefused(CommissioningError):
    """What was asked for is refused before any step is done."""


class LeftTravel(CommissioningError):
    """The platform strayed from its reference; the amplifier was switched off."""
