"""The files that the steps leave in the folder beside the record and the bags."""

from collections.abc import Mapping

LOOP, LIMITS, STROKE, LEARNED = "loop.png", "limits.yaml", "stroke.png", "learned.csv"
PAGE, FIGURES, TUNED = "certificate.html", "certificate.json", "tuned.yaml"
STEP_FILES: Mapping[str, tuple[str, ...]] = {
    "frequency_response": (LOOP,),
    "acceptance": (LIMITS, STROKE, LEARNED),
    "certificate": (PAGE, FIGURES, TUNED),
}
"""By the step that writes them."""
