"""The description of a stage: each fact about the machine once, and how well it is known; and how a simulated machine
differs from it.

Nodes declare it as the parameters `stage.*`; a stage file sets them under the wildcard node `/**`, for all at once.
"""

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.model.actuator import ActuatorParameters
from straightcomp_ros.model.converters import DriveParameters, EncoderParameters
from straightcomp_ros.model.disturbances import DisturbanceParameters
from straightcomp_ros.model.friction import DESCRIBED, ContactParameters, LuGreParameters
from straightcomp_ros.model.modes import ModeParameters, ModesParameters, TrueModesParameters, off
from straightcomp_ros.model.motion import MotionParameters, reach
from straightcomp_ros.model.plant import PlantParameters, PlatformParameters
from straightcomp_ros.parameters.declaration import ParameterError, RefusedParameter, group, parameter, to_mapping
from straightcomp_ros.straightness.feedforward import FeedforwardParameters, outdated_handover
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey_header import WAYS

T = TypeVar("T", ActuatorParameters, LuGreParameters)
_CHANGEABLE = ("motion.", "guide.", "actuator.current_limit", "serial")
"""Facts that may differ between nodes: the strokes, what a single node may be given anew while it runs, and what no
node computes with."""
_PLACES = 20_001
"""Of a stroke, at which its references are looked at: nearer to each other than the points of its survey."""
_FASTEST_POLE = 20.0
"""Of the magnets' negative stiffness, √(K̄_y/M), per sampling period: none is controllable beyond 0.65, and much faster
ones are no numbers after a sample."""


@dataclass(frozen=True)
class UncertaintyParameters:
    """How far a machine may be from its description: ranges of a sweep. The converters and the guide stay nominal."""

    mass: float = parameter(0.2, "Mass: uniform within ± this fraction of it", "[0, 0.9]")
    force: float = parameter(
        0.2,
        "Force of the magnets at the same gap and currents (turns² times pole area, and so K̄_i and K̄_y): uniform "
        "within ± this fraction of it",
        "[0, 0.9]",
    )
    air_gap: float = parameter(0.1, "Air gap: uniform within ± this fraction of it", "[0, 0.9]")
    friction: float = parameter(
        2.0,
        "Coulomb, static and viscous friction: log-uniform between one over this factor and this factor; bristles "
        "keep their stiffness and damping",
        "[1, 100]",
    )
    amplifier: float = parameter(
        1.0, "Amplifier's bandwidth: log-uniform between one over this factor and this factor", "[1, 100]"
    )
    sensor_noise: float = parameter(
        0.5,
        "Noise on y before the encoder rounds: normal, white; its standard deviation is uniform from 0 to this",
        "[0, 1000] counts",
    )
    shortest_delay: float = parameter(
        0.2, "Command delay, constant in a trial: uniform from this, relative to drive.delay", "[0, 10]"
    )
    longest_delay: float = parameter(
        1.5, "Command delay, constant in a trial: uniform up to this, relative to drive.delay", "[0, 10]"
    )
    jitter: float = parameter(
        0.04,
        "Time from each sample's place on the grid: uniform within ± this; the stamp has the true time",
        "[0, 0.4] samples",
    )
    map_noise: float = parameter(
        0.02e-6, "Standard deviation of an error of each point of the survey: normal", "[0, 1e-5] m"
    )

    def __post_init__(self) -> None:
        if self.longest_delay < self.shortest_delay:
            raise RefusedParameter(
                "longest_delay",
                f"{self.longest_delay!r} is below the shortest; allowed: >= {self.shortest_delay!r} "
                "('{group}shortest_delay')",
            )

    def factors(self, mass: float, force: float, air_gap: float, friction: float, amplifier: float = 0.0) -> "Factors":
        """The machine at these places of its ranges, each from −1 to 1; of friction and amplifier in logarithms."""
        relative = (1.0 + self.mass * mass, 1.0 + self.force * force, 1.0 + self.air_gap * air_gap)
        return Factors(*relative, self.friction**friction, self.amplifier**amplifier)


@dataclass(frozen=True)
class StageParameters:
    """The description of a stage; its defaults are those of the shipped synthetic one."""

    name: str = parameter("synthetic", "Name of the stage, for reports")
    serial: str = parameter("", "Serial number of the machine, for its certificate; empty: not given")
    # At lower ones a period comes near the gap between samples after which a run begins anew (servo.py, pairing.py).
    rate: int = parameter(DEFAULT_RATE, "Samples and control cycles per second", "[100, 20000] Hz")
    motion: MotionParameters = group(MotionParameters, "Strokes of the stage")
    guide: MapParameters = group(MapParameters, "Map of the guide")
    platform: PlatformParameters = group(PlatformParameters, "Platform")
    actuator: ActuatorParameters = group(ActuatorParameters, "Magnets")
    friction: LuGreParameters = group(LuGreParameters, "Friction between slider and platform")
    drive: DriveParameters = group(DriveParameters, "D/A converter and amplifier")
    encoder: EncoderParameters = group(EncoderParameters, "Encoders")
    uncertainty: UncertaintyParameters = group(UncertaintyParameters, "How well it is known")

    def __post_init__(self) -> None:
        stop, gap = self.platform.stop, self.actuator.air_gap
        if stop >= gap:
            raise RefusedParameter(
                "platform.stop",
                f"{stop!r} m is not inside the air gap; allowed: < {gap!r} m ('{{group}}actuator.air_gap')",
            )
        magnets, mass = self.actuator.position_stiffness, self.platform.mass
        if magnets > mass * (_FASTEST_POLE * self.rate) ** 2:
            raise RefusedParameter(
                "platform.mass",
                f"{mass!r} kg leaves the middle within a sample: the magnets' stiffness is {magnets:.3g} N/m "
                "('{group}actuator.air_gap', '{group}actuator.turns', '{group}actuator.pole_area', "
                f"'{{group}}actuator.bias_current'); allowed: >= {magnets / (_FASTEST_POLE * self.rate) ** 2:.3g} kg "
                "at this '{group}rate'",
            )

    @property
    def identity(self) -> str:
        """Name and checksum; all nodes of a graph must have the same."""
        facts = {name: value for name, value in to_mapping(self).items() if not name.startswith(_CHANGEABLE)}
        return f"{self.name} {hashlib.blake2b(json.dumps(facts).encode(), digest_size=4).hexdigest()}"

    @property
    def period(self) -> float:
        """Sampling period in s."""
        return 1.0 / self.rate

    @property
    def period_ns(self) -> int:
        """Sampling period in ns."""
        return round(1e9 / self.rate)

    @property
    def delay(self) -> float:
        """Time in s from a sample until its command takes effect."""
        return self.drive.delay * self.period

    @property
    def highest_current(self) -> float:
        """Largest control current in A that the limit and the D/A converter allow."""
        return min(self.actuator.current_limit, self.drive.largest_current)

    @property
    def negative_stiffness(self) -> float:
        """Of the platform, N/m: what the magnets have beyond the flexure; below 0 the flexure holds it by itself."""
        return self.actuator.position_stiffness - self.platform.stiffness

    @property
    def quantum(self) -> float:
        """Force in N of the encoder's count against magnets and flexure, and of a step of the D/A converter."""
        count = abs(self.negative_stiffness) * self.encoder.y_resolution
        return count + self.drive.current_step * self.actuator.current_stiffness

    @property
    def dead_time(self) -> float:
        """T_d = delay T + T/2 + 1/(2π f_amplifier) in s: delay, mean age of a held command, and the amplifier's lag."""
        return (self.drive.delay + 0.5) * self.period + 1.0 / (2.0 * math.pi * self.drive.bandwidth)

    def lacking(self, straightness: StraightnessMap, bandwidth: float) -> float:
        """Way in m that ṙ leads the platform too little where a ramp begins or ends.

        Three poles at ω = 2πf (``bandwidth`` f in Hz) learn of a step a of the acceleration so late that 3 r' a/ω² is
        missing (final value of the filter's error).
        """
        return 3.0 * straightness.steepest * self.motion.acceleration / (2.0 * math.pi * bandwidth) ** 2

    def tracking(self, least: FeedforwardParameters, straightness: StraightnessMap) -> FeedforwardParameters:
        """The feedforward's tracking of this stage: ``least``, with as much bandwidth that no more is lacking than y is
        rounded by. The rounding of x allows that: it moves r itself by more than what ṙ and r̈ make of it."""
        lacking = self.lacking(straightness, least.bandwidth)
        asked = least.bandwidth * math.sqrt(lacking / self.encoder.y_rounding)
        bandwidth = max(least.bandwidth, min(asked, self.rate / (2.0 * math.pi)))
        return dataclasses.replace(least, bandwidth=bandwidth)

    def outdated(self, straightness: StraightnessMap, lead: float) -> float:
        """Largest error in m of a reference of a while ago (``lead`` in s), extrapolated by its two rates: along the
        map at full speed, there and back, or from one table to the other after a reversal, together with a ramp's begin
        or end, which no earlier reference shows."""
        low, high = reach(self.motion)
        x, way, ramp = np.linspace(low, high, _PLACES), self.motion.speed * lead, self.motion.acceleration
        missed = [outdated_handover(straightness.hysteresis, ramp, straightness.reversal, lead)]
        for direction, ahead in zip(WAYS, (way, -way), strict=True):
            at = x[(x + ahead >= low) & (x + ahead <= high)]
            r, slope, curvature = straightness.evaluate(at, direction)
            error = straightness.evaluate(at + ahead, direction)[0] - (r + (slope + 0.5 * curvature * ahead) * ahead)
            missed.append(float(np.abs(error).max(initial=0.0)))
        return max(missed) + 0.5 * straightness.steepest * ramp * lead**2

    def enough_lead(self, straightness: StraightnessMap, longest: float) -> float:
        """How old a reference may be, in s: as ``longest``, or where that errs by more than the rounding of y, by as
        many samples as it does not, at least one."""
        error = self.outdated(straightness, longest)
        if error <= self.encoder.y_rounding:
            return longest
        # The error grows at least with the square of the lead.
        samples = math.floor(longest * math.sqrt(self.encoder.y_rounding / error) * self.rate)
        return min(longest, max(1, samples) / self.rate)

    def with_modes(self, *modes: ModeParameters) -> "StageParameters":
        """The stage with these modes of its platform, at most two, in the place of its own."""
        return dataclasses.replace(self, platform=dataclasses.replace(self.platform, modes=ModesParameters(*modes)))

    @property
    def plant(self) -> PlantParameters:
        """The machine as described."""
        return PlantParameters(
            platform=self.platform,
            actuator=self.actuator,
            friction=self.friction,
            contact=ContactParameters(self.friction.model),
            drive=self.drive,
            encoder=self.encoder,
        )


class Factors(NamedTuple):
    """A machine relative to its description; each field as the parameter of :class:`TruthParameters`."""

    mass: float = 1.0
    force: float = 1.0
    air_gap: float = 1.0
    friction: float = 1.0
    amplifier: float = 1.0
    modes: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shares of the uncertainty of the modes' frequencies, dampings and participations, from −1 to 1."""


@dataclass(frozen=True)
class TruthParameters:
    """How the simulated machine differs from its description."""

    mass: float = parameter(1.0, "Mass relative to the description", "[0.01, 100]")
    force: float = parameter(1.0, "Magnets' force, at the same gap and currents, relative to it", "[0.01, 100]")
    air_gap: float = parameter(1.0, "Air gap relative to it", "[0.01, 100]")
    friction: float = parameter(
        1.0, "Coulomb, static and viscous friction relative to it; bristles keep stiffness and damping", "[0, 1000]"
    )
    amplifier: float = parameter(1.0, "Bandwidth of the amplifier relative to it", "[0.01, 100]")
    guide: str = parameter("", "Survey file of the true guide; empty: that of the description")
    contact: ContactParameters = group(ContactParameters)
    modes: TrueModesParameters = group(TrueModesParameters)
    disturbances: DisturbanceParameters = group(DisturbanceParameters, "Simulated disturbance")

    @property
    def factors(self) -> Factors:
        """The factors as :func:`deviating` takes them."""
        return Factors(self.mass, self.force, self.air_gap, self.friction, self.amplifier)


def true_plant(stage: StageParameters, truth: TruthParameters) -> PlantParameters:
    """The simulated machine; ParameterError if its air gap does not hold the mechanical stop, or if its table of force
    over x is refused."""
    plant = deviating(stage.plant, truth.factors)
    if (modes := truth.modes.as_described).present:
        plant = dataclasses.replace(plant, platform=dataclasses.replace(plant.platform, modes=modes))
    contact = truth.contact
    if contact.model == DESCRIBED:
        contact = dataclasses.replace(contact, model=stage.friction.model)
    return dataclasses.replace(plant, contact=contact, disturbances=truth.disturbances.machine())


def true_guide(stage: StageParameters, truth: TruthParameters) -> StraightnessMap:
    """The simulated guide; SurveyError if its survey is refused."""
    if truth.guide:
        return load_map(dataclasses.replace(stage.guide, file=truth.guide, smooth="none", direction="both"))
    return load_map(stage.guide)


def deviating(plant: PlantParameters, factors: Factors) -> PlantParameters:
    """``plant`` with ``factors``.

    Raises:
        ParameterError: the narrower air gap does not hold the mechanical stop.
    """
    gap, stop = plant.actuator.air_gap * factors.air_gap, plant.platform.stop
    if stop >= gap:
        raise ParameterError(
            f"air gap × {factors.air_gap:.4g}: {gap:.4g} m does not hold the stop; "
            f"allowed: > {stop!r} m ('stage.platform.stop')"
        )
    modes = ModesParameters(*(off(mode, *factors.modes) for mode in plant.platform.modes.present))
    platform = dataclasses.replace(plant.platform, mass=plant.platform.mass * factors.mass, modes=modes)
    # The area stands for turns² times area, the product in (2), and scales it exactly.
    actuator = _scaled(_scaled(plant.actuator, factors.force, "pole_area"), factors.air_gap, "air_gap")
    friction = _scaled(plant.friction, factors.friction, "coulomb", "static", "viscous")
    drive = dataclasses.replace(plant.drive, bandwidth=plant.drive.bandwidth * factors.amplifier)
    return dataclasses.replace(plant, platform=platform, actuator=actuator, friction=friction, drive=drive)


def _scaled(parameters: T, factor: float, *names: str) -> T:
    return dataclasses.replace(parameters, **{name: getattr(parameters, name) * factor for name in names})
