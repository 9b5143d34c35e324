"""What is designed of each law: its gains by name, the closed form that gives a start, and how they are put in.

Times scale with the loop's dead time T_d (:mod:`straightcomp_ros.stage.description`): a gain that is a rate is a
constant over T_d. The constants were found by a search on the shipped stage.

Three parameters of `smc_observer` are not searched, since they follow from the stage:

- Delay: a little less than that of the commands.
- First size of friction: the smallest that the uncertainty allows. Too much friction in the law makes limit cycles, too
  little leaves an error at the first reversals, until the fit has seen one: the more friction, the larger the error.
- Memory of the fit: many reversals of the reference. Before the first reversal friction and a constant force look
  the same; a shorter memory lets the fit drift there.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.control.sliding_mode import reaching_bound
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.parameters.declaration import from_mapping, to_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import map_of

T = TypeVar("T")
Values = Mapping[str, float]
"""Numbers by dotted name, from ``control.`` on."""
_BELOW = 0.9
_REVERSALS = 75.0
"""10 s on the shipped stage; with 2 s the errors at the first reversals were up to six times as large."""
_MEMORY = (2.0, 100.0)
_POINTS = 5000


class SearchedGain(NamedTuple):
    """One gain of a law."""

    name: str  # dotted, from ``control.`` on
    low: float  # range of the search, relative to the rule's value; itself if ``power`` is 0
    high: float
    power: int = 1  # of 1/T_d with which the gain grows; 0 for a gain whose useful range is the same for all stages
    step: float = 1.0  # first step of a search, relative to those of the others


_OBSERVER = "control.smc_observer."
_SMC = "control.smc."
_LINEAR = (
    SearchedGain(_SMC + "zeta", 0.3, 3.0, power=0),
    SearchedGain(_SMC + "natural_frequency", 0.2, 5.0),
    SearchedGain(_SMC + "phi", 0.1, 10.0),
    SearchedGain(_SMC + "velocity_bandwidth", 0.1, 4.0),
)
SEARCHED: Mapping[str, tuple[SearchedGain, ...]] = {
    "linear": _LINEAR,
    "smc": (*_LINEAR, SearchedGain(_SMC + "boundary_layer", 0.2, 10.0, power=-1)),
    "smc_observer": (
        SearchedGain(_OBSERVER + "bandwidth", 0.1, 4.0),
        SearchedGain(_OBSERVER + "third_pole", 0.03, 5.0, power=0),
        SearchedGain(_OBSERVER + "surface", 0.1, 10.0),
        SearchedGain(_OBSERVER + "reaching", 0.1, 10.0),
        SearchedGain(_OBSERVER + "gain_allowance", 0.7, 4.0, power=0),
        SearchedGain(_OBSERVER + "velocity_share", 0.05, 1.0, power=0),
    ),
}
"""The gains that are searched, by law; all on a logarithmic scale."""
_FILTERS = "control.filters."
SHAPES = (
    *(
        SearchedGain(f"{_FILTERS}{notch}.{name}", *bounds, power=0, step=step)
        for notch in ("first", "second")
        # A notch that is off by a tenth of the frequency is none.
        for name, bounds, step in (
            ("frequency", (1.0, 20_000.0), 0.1),
            ("width", (0.02, 4.0), 1.0),
            ("depth", (0.001, 0.9), 1.0),
            ("poles", (0.5, 3.0), 0.5),
        )
    ),
    SearchedGain(_FILTERS + "roll_off.frequency", 1.0, 20_000.0, power=0),
)
"""What is searched besides where a filter is in the start."""


_OF_ENDS = ("bandwidth", "surface", "reaching", "third_pole", "gain_allowance", "velocity_share")
_ENDS = (
    # Where searches ended on other stages; the first three relative to the rule.
    (0.51, 0.83, 2.63, 1.28, 1.76, 0.83),  # an encoder of 5 nm
    (0.21, 0.87, 2.86, 0.55, 1.41, 0.56),  # 20 kg
    (2.19, 1.09, 0.57, 2.07, 1.59, 0.29),  # 1 kHz
    (0.53, 0.43, 1.36, 0.78, 1.77, 0.34),  # an encoder of 0.5 µm
    (2.51, 0.36, 4.42, 0.42, 1.96, 0.30),  # an amplifier of 150 Hz
    (1.43, 0.34, 6.32, 0.31, 1.82, 0.45),  # four times the friction
    (0.20, 0.42, 0.82, 0.83, 1.12, 0.51),  # 8 kHz and an encoder of 5 nm
    (0.47, 4.82, 0.53, 0.34, 1.59, 0.73),  # 4 kHz
    (0.53, 1.82, 2.00, 0.45, 1.40, 0.74),  # a joint in the guide
    (2.26, 0.72, 0.44, 1.07, 2.02, 0.24),  # 8 kHz, 5 nm, an amplifier of 2 kHz
    (0.60, 4.12, 0.19, 0.083, 0.90, 0.30),  # no friction
)
_FACTORS = (0.5, 0.7, 1.4, 2.0)
_FILTERED = ((0.85, 1.0), (0.7, 2.0), (0.5, 3.0))
"""Of the loop's speed and a notch's width: what a filter costs in phase, the loop must leave."""


def starts(law: str, gains: Values) -> list[dict[str, float]]:
    """Gains from which a search may begin, the rule's ``gains`` first: the best of them is in the right valley."""
    slower = [
        {**scaled(law, gains, speed), **{name: width * gains[name] for name in gains if name.endswith(".width")}}
        for speed, width in _FILTERED
        if any(name.startswith(_FILTERS) for name in gains)
    ]
    if law != "smc_observer":
        return [dict(gains), *slower, *(scaled(law, gains, factor) for factor in _FACTORS)]
    names = [_OBSERVER + name for name in _OF_ENDS]
    scales = [gains[name] for name in names[:3]] + [1.0] * 3
    ends = ((x * scale for x, scale in zip(end, scales, strict=True)) for end in _ENDS)
    return [dict(gains), *slower, *({**gains, **dict(zip(names, end, strict=True))} for end in ends)]


def rule(law: str, stage: StageParameters) -> dict[str, float]:
    """The gains of ``law`` on ``stage`` in closed form, by dotted name."""
    lag = stage.dead_time
    if law == "smc_observer":
        return {
            _OBSERVER + "bandwidth": 0.219 / lag,
            _OBSERVER + "third_pole": 1.28,
            # A little less than the true delay: the law may not count on a command that is later than it believes.
            _OBSERVER + "delay": min(1.0, 0.88 * stage.drive.delay),
            _OBSERVER + "surface": 0.614 / lag,
            _OBSERVER + "reaching": 0.423 / lag,
            _OBSERVER + "gain_allowance": 1.7,
            _OBSERVER + "velocity_share": 0.3,
        }
    smc = law == "smc"
    gains = {
        _SMC + "zeta": 0.5 if smc else 0.8,
        _SMC + "natural_frequency": (0.04 if smc else 0.0374) / lag,
        _SMC + "phi": (0.05 if smc else 0.107) / lag,
        _SMC + "velocity_bandwidth": 1.07 / lag,
    }
    if smc:
        # A tenth more than (11) asks with the gains above; inside the layer ρ/ε adds to φ.
        rho = 1.1 * reaching_bound(with_gains(ControlParameters(), "linear", gains).smc, stage)
        gains |= {_SMC + "rho": rho, _SMC + "boundary_layer": rho * lag / 0.16}
    return gains


def scaled(law: str, gains: Values, factor: float) -> dict[str, float]:
    """``gains`` of ``law`` as for a loop that is faster by ``factor``."""
    powers = {gain.name: gain.power for gain in SEARCHED[law]}
    return {name: value * factor ** powers.get(name, 0) for name, value in gains.items()}


def with_gains(control: ControlParameters, law: str, values: Values) -> ControlParameters:
    """``control`` with the law ``law`` and ``values``, by dotted name.

    Raises:
        ParameterError: a value is refused, as a node would.
    """
    own = {name.removeprefix("control."): value for name, value in values.items()}
    return from_mapping(ControlParameters, {**to_mapping(control), **own, "law": law})


def shapes_for(stage: StageParameters) -> dict[str, dict[str, float]]:
    """Filters that may answer the modes of ``stage``, by a name in words: a start of each; none without modes.

    Poles above a notch's zeros cost less phase, at the price of gain above both. A collocated mode may be left alone by
    any loop that is slow enough, and so may none: that is among them.
    """
    modes = stage.platform.modes.present
    if not modes:
        return {"no filter": {}}
    notches = {
        f"{_FILTERS}{notch}.{name}": value
        for notch, mode in zip(("first", "second"), modes, strict=False)
        for name, value in (("frequency", mode.frequency), ("width", 0.3), ("depth", 0.05), ("poles", 1.4))
    }
    roll_off = {_FILTERS + "roll_off.frequency": 0.7 * min(mode.frequency for mode in modes)}
    return {"a notch": notches, "a roll-off": roll_off, "less bandwidth": {}}


def following(scenario: Scenario, law: str) -> dict[str, float]:
    """The parameters of ``law`` that follow from the stage, by dotted name from ``control.`` on."""
    if law != "smc_observer":
        return {}
    least, most = _MEMORY
    stage = scenario.description
    return {
        "control.smc_observer.first_size": min(1.0, max(0.1, _BELOW / stage.uncertainty.friction)),
        "control.smc_observer.memory": min(most, max(least, _REVERSALS * _between_reversals(scenario))),
    }


def _between_reversals(scenario: Scenario) -> float:
    """Mean time in s between reversals of r while the stage moves, counting the turn of the stage."""
    times = np.linspace(0.0, scenario.trajectory.end_ns, _POINTS)
    x = scenario.trajectory.at(times.astype(np.int64))
    moving = np.flatnonzero(np.diff(x) != 0.0)
    straightness = map_of(scenario.survey, scenario.description.guide)
    direction = np.sign(np.diff(straightness.evaluate(x)[0])[moving])
    reversals = int(np.count_nonzero(np.diff(direction[direction != 0.0])))
    return float(moving.size * (times[1] - times[0]) * 1e-9 / max(1, reversals))


def closed_form(scenario: Scenario, law: str) -> dict[str, float]:
    """The values of ``law`` in closed form, by dotted name: gains, and what follows from the stage."""
    return {**rule(law, scenario.description), **following(scenario, law)}


def scaled_facts(described: T, facts: Sequence[str], factor: float) -> T:
    """A stage or a plant with the ``facts``, dotted names of its numbers, times ``factor``; ParameterError if one is
    refused."""
    groups: dict[str, list[str]] = {}
    for fact in facts:
        name, _, rest = fact.partition(".")
        groups.setdefault(name, []).append(rest)

    def changed(name: str) -> Any:
        now = getattr(described, name)
        if dataclasses.is_dataclass(now):
            return scaled_facts(now, groups[name], factor)
        # The rate alone is a whole number.
        return round(factor * now) if isinstance(now, int) else factor * now

    return dataclasses.replace(described, **{name: changed(name) for name in groups})  # type: ignore[type-var]
