"""What a record cannot tell, in sentences: an estimate is to be read together with its limits."""

import math

from straightcomp_ros.tuning.identification.estimate import UNITS, Estimate
from straightcomp_ros.tuning.identification.unknowns import FORCE_SCALE


def untold(estimate: Estimate) -> list[str]:
    """Sentences on what the record leaves open; one at least, since no record gives forces a scale of their own."""
    found, path = estimate.parameters, estimate.path
    given = [name for name in FORCE_SCALE if found[name].known]
    sentences = [
        f"Forces have no scale of their own: {' and '.join(given)} was given. If it is wrong, mass, magnetic force and "
        "friction are wrong by one common factor; their ratios, which a law needs, are not."
    ]
    if math.isnan(path.delay):
        sentences.append(
            "Command and measured current fit no first-order amplifier, as where many commands come late: this record "
            "tells no bandwidth and no delay."
        )
    elif not path.rate_found:
        sentences.append(
            "The latency jitters too much to tell the amplifier's bandwidth: that of the description holds."
        )
    told: set[frozenset[str]] = set()
    for one in found.values():
        for other in one.with_others:
            pair = frozenset((one.name, other))
            if pair not in told:
                told.add(pair)
                sentences.append(
                    f"{one.name} and {other} can hardly be told apart: each may take what the other lacks."
                )
        if one.poor:
            unit = f" {UNITS[one.name]}" if UNITS[one.name] else ""
            sentences.append(f"{one.name} is only known to lie between {one.low:.3g} and {one.high:.3g}{unit}.")
    return sentences
