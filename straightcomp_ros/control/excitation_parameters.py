"""The parameters of an excitation, apart from what it is computed with: nodes that never excite read them too."""

from dataclasses import dataclass

from straightcomp_ros.parameters.declaration import parameter

_TRANSIENT_S = 0.5
"""However short the period: the loop's transient does not follow it. With the default period a lead of 0.3 s, 0.5 s or
1 s makes no difference to the response or its spread."""


@dataclass(frozen=True)
class MultisineParameters:
    """The excitation of a frequency response."""

    lowest: float = parameter(2.0, "Lowest frequency of the excitation", "(0, 10000] Hz")
    highest: float = parameter(
        500.0, "Highest frequency of the excitation; at most 0.4 times the sampling rate is used", "(0, 10000] Hz"
    )
    lines: int = parameter(40, "Frequencies of the excitation, evenly spaced on a logarithmic scale", "[2, 1000]")
    period: float = parameter(
        1.0, "Period of the excitation; its inverse is the spacing of the frequencies", "(0, 60] s"
    )
    draws: int = parameter(40, "Draws of random phases", "[3, 100]")
    current: float = parameter(0.25, "RMS of the injected current", "(0, 10] A")
    travel: float = parameter(3e-4, "Largest |y − r|, beyond which the excitation ends early", "(0, 0.1] m")
    # A sum of sines rarely passes four times its RMS.
    motion: float = parameter(
        1.0 / 6.0, "RMS of the excited motion that the excitation aims at, at most, relative to the travel", "(0, 1]"
    )
    seed: int = parameter(1, "Seed of the phases", "[0, 2147483647]")

    @property
    def lead(self) -> float:
        """Time before the period of each draw in which the transient dies, s."""
        return max(0.5 * self.period, min(self.period, _TRANSIENT_S))

    @property
    def seconds(self) -> float:
        """Length of all draws, s."""
        return (self.lead + self.period) * self.draws


@dataclass(frozen=True)
class ExcitationParameters(MultisineParameters):
    """An excitation of any kind."""

    signal: str = parameter(
        "multisine",
        "Kind of the excitation. multisine: a sum of sines, for frequency responses. shake: random steps of the "
        "current, each taken back by the next. ramp_up, ramp_down: from zero to the current, or to its negative",
        choices=("multisine", "shake", "ramp_up", "ramp_down"),
    )
    duration: float = parameter(1.0, "Length of a shake or a ramp", "(0, 60] s")
