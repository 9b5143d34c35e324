"""The files that commissioning leaves in its folder."""

import itertools
from collections.abc import Mapping

LOOP, LIMITS, STROKE, LEARNED = "loop.png", "limits.yaml", "stroke.png", "learned.csv"
PAGE, FIGURES, TUNED = "certificate.html", "certificate.json", "tuned.yaml"
STEP_FILES: Mapping[str, tuple[str, ...]] = {
    "frequency_response": (LOOP,),
    "acceptance": (LIMITS, STROKE, LEARNED),
    "certificate": (PAGE, FIGURES, TUNED),
}
"""By the step that writes them."""
RECORD = "commission.json"
MADE = (RECORD, "bags", "logs", "parameters.yaml", *itertools.chain(*STEP_FILES.values()))
"""All of them."""
