"""The motion of a run as a verdict sees it: what was measured, what is known of the machine, and what is allowed.

A run is judged by what its stage was promised (:mod:`straightcomp_ros.offline.promise`): the error of the described
machine under the same law, and a map as good as its described noise. An error of half of what a platform that stands
still would leave, on the whole guide of the map, is too large whatever was promised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.interruption import Stall
from straightcomp_ros.analysis.metrics import RESTING
from straightcomp_ros.analysis.record import AT_LIMIT, Array, MetricsError, Stroke, motion_of, whole
from straightcomp_ros.control.laws import ControlParameters, dither_of
from straightcomp_ros.control.margins import missing_margin, unstable_where
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters, node_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak

if TYPE_CHECKING:
    from straightcomp_ros.offline.promise import Promise

RECOVERY = 0.1
"""Time in s after a disturbance in which its error decays: some ten periods of the slowest usual loop's bandwidth."""
RECOVERY_SAMPLES = 200
"""The same in samples, for a loop that samples slowly: its bandwidth is lower too."""
_COUNTED = 1e-12
"""Difference of two readings in m below which they are the same count, but for rounding."""
HARM = 2.0
"""A disturbance did harm if the error is larger by this factor, p-p, than without the samples that it disturbed."""
_SIGMAS = 8.0
"""Standard deviations, p-p, of what the noise of a survey leaves in its map: of 1,000 surveys with 200 points, one
exceeds it."""
_MAP_COUNTS = 2.0
"""Counts of the encoder, p-p, below which an error of the map is not seen."""
ACCURATE = 0.5
"""Largest error relative to the uncompensated deviation, both p-p, whatever was promised."""
FEW_COUNTS = 3.0
"""Counts of the encoder, p-p, which the best law leaves: no less is asked for on a nearly straight guide."""
_OF_A_COUNT = 1.0 / math.sqrt(12.0)
"""RMS of rounding in counts."""
_STILL_SHARE = 0.01
"""Travel of a reference that asks for nothing, relative to the true guide's deviation: the run is uncompensated, unless
its map asks for more elsewhere. A count of the encoder is nothing either."""


def bounds_of(
    parameters: Mapping[str, Mapping[str, Any]], straightness: StraightnessMap | None = None
) -> dict[str, Any]:
    """The bounds of a :class:`JudgedMotion` by name, from parameters of each node alone, by dotted name, as a bag has
    them, and from the map.

    A node that is there has its defaults for what is not named; of one that is not, nothing is known. A board on CAN
    reports neither its stop nor its converter, unless it is the emulator.
    """
    bounds: dict[str, Any] = {}
    shipped, limits = StageParameters(), []
    if "controller" in parameters:
        limits.append(recorded_limit(parameters["controller"]))
    driver = parameters.get("driver", {"hardware": "unknown"})
    if is_simulated(driver):
        bounds["stop"] = float(driver.get("stage.platform.stop", shipped.platform.stop))
        limits.append(recorded_drive(driver).largest_current)
    if limits:
        bounds["current_limit"] = float(min(limits))
    if straightness is not None:
        runout = float(parameters.get("feedforward", {}).get("stage.guide.runout", shipped.guide.runout))
        bounds["span"] = (straightness.span[0] - runout, straightness.span[1] + runout)
        bounds["map_pp"] = peak_to_peak(straightness.evaluate(straightness.report.x)[0])
    if "controller" in parameters:
        for name in ("friction", "sensor_noise", "map_noise"):
            known = parameters["controller"].get(f"stage.uncertainty.{name}", getattr(shipped.uncertainty, name))
            bounds[name] = float(known)
        modes = (parameters["controller"].get(f"stage.platform.modes.{one}.frequency") for one in ("first", "second"))
        bounds["modes"] = tuple(float(one) for one in modes if one)
        if bounds["modes"]:
            bounds["destabilised"] = partial(destabilised, parameters["controller"])
        if node := _described(parameters["controller"]):
            bounds["unstable_where"] = partial(unstable_where, node.control, node.stage)
            bounds["dither"] = dither_frequency(node.control, node.stage)
            bounds["resolution"] = node.stage.encoder.y_resolution
            bounds["coulomb"] = node.stage.friction.coulomb
            bounds["current_stiffness"] = node.stage.actuator.current_stiffness
    return bounds


def _described(controller: Mapping[str, Any]) -> ControllerNodeParameters | None:
    """The controller by its parameters; None where they are of another version or law."""
    with suppress(ParameterError):
        known: ControllerNodeParameters = node_parameters("controller", {"controller": controller})
        return known
    return None


def dither_frequency(control: ControlParameters, stage: StageParameters) -> float:
    """Frequency in Hz of the law's dither; 0 where there is none."""
    dither = dither_of(control.smc_observer, stage)
    return dither.angle / math.tau * stage.rate if control.law == "smc_observer" and dither.amplitude > 0.0 else 0.0


def destabilised(controller: Mapping[str, Any]) -> bool:
    """Whether the platform's modes take margins from the law on its own description."""
    known = _described(controller)
    if known is None or not known.stage.platform.modes.present:
        return False
    missing = missing_margin(known.control, known.stage)
    return missing is not None and missing != missing_margin(known.control, known.stage.with_modes())


def is_simulated(driver: Mapping[str, Any]) -> bool:
    """Whether the driver with these parameters by dotted name has a simulated stage, if need be behind a board."""
    return driver.get("hardware", "simulated") == "simulated" or bool(driver.get("can.simulated_stage", False))


def recorded_drive(driver: Mapping[str, Any]) -> DriveParameters:
    """D/A converter and amplifier from the driver's parameters by dotted name; defaults for what they do not name."""
    given = {name: driver.get(f"stage.drive.{name}", value) for name, value in asdict(DriveParameters()).items()}
    return DriveParameters(int(given.pop("dac_bits")), *map(float, given.values()))


def recorded_limit(controller: Mapping[str, Any]) -> float:
    """Largest control current in A that the law may command, from the controller's parameters as of
    :func:`recorded_drive`."""
    limit = controller.get("stage.actuator.current_limit", StageParameters().actuator.current_limit)
    return min(float(limit), recorded_drive(controller).largest_current)


class Left(NamedTuple):
    """An error in m: p-p, and RMS about its mean."""

    pp: float
    rms: float


class GuideFit(NamedTuple):
    """How the guide's true deviation fits the map, from the least squares line, in m: p-p of the guide, p-p of what a
    platform that follows the map exactly would leave, and why it does."""

    guide_pp: float
    left_pp: float
    cause: str = ""
    noise: float = 0.0  # standard deviation of the sensor's noise that is left


@dataclass(frozen=True, eq=False)
class JudgedMotion:
    """The motion of a run, from its first to its last sample, pauses included; arrays (n,), in s, m and A. Positions
    and error are the true ones if they are known, otherwise as the encoders see them. Unknown bounds are infinite."""

    time: Array
    x: Array
    y: Array
    r: Array
    current: Array
    error: Array  # r − y
    count: float  # one count of the encoder of y
    fit: GuideFit | None = None  # of guide and map; None where the guide is not known
    stalls: Sequence[Stall] = ()  # of the host within the motion
    current_limit: float = math.inf  # largest |i_c| that the law may command and the D/A converter can
    stop: float = math.inf  # the platform's mechanical stop at ± this position
    span: tuple[float, float] = (-math.inf, math.inf)  # of x in which the map's reference follows the guide or runs out
    map_pp: float = 0.0  # m, p-p of the map's reference over the whole guide; 0: flat, or not known
    late: str = ""  # that commands came later than described, as of `late_commands`
    by_encoder: bool = False  # whether y and the error are the encoder's
    unseen: bool = False  # whether the error is hardly in the encoder's readings
    zero: float = 0.0  # m, true x where x reads 0; 0 where that is not known
    promise: Callable[[], Promise | None] = lambda: None  # what the description leaves on this motion
    # Of the description, see `UncertaintyParameters`.
    friction: float = 2.0
    sensor_noise: float = 0.5
    map_noise: float = 0.02e-6
    modes: Sequence[float] = ()  # Hz, described resonances of the platform
    destabilised: Callable[[], bool] = lambda: False  # whether these take margins from the law
    unstable_where: Callable[[], str] = lambda: ""  # the law is, within the uncertainty of its description, in words
    coulomb: float = 0.0  # N, friction; 0: none, or not known
    current_stiffness: float = 0.0  # N/A, of the magnets
    dither: float = 0.0  # Hz, of the sine that the law itself adds; 0: none
    resolution: float = 0.1e-6  # m, of the encoder of y: the count that a platform at rest does not show

    @cached_property
    def period(self) -> float:
        """Sampling period in s."""
        return float(np.median(np.diff(self.time)))

    @property
    def recovery(self) -> int:
        """Samples in which the error of a disturbance decays."""
        return max(round(RECOVERY / self.period), RECOVERY_SAMPLES)

    @property
    def limited(self) -> NDArray[np.bool_]:
        """The samples (n,) whose command is at the current limit."""
        return np.asarray(np.abs(self.current) >= AT_LIMIT * self.current_limit)

    @cached_property
    def pp(self) -> float:
        """Error in m, peak to peak."""
        return peak_to_peak(self.error)

    @cached_property
    def travel(self) -> float:
        """Of the reference in m, peak to peak."""
        return peak_to_peak(self.r)

    @property
    def uncompensated(self) -> float:
        """What a platform that stands still would leave: p-p of the reference, or of the guide if that is more."""
        return max(self.travel, self.fit.guide_pp if self.fit else 0.0)

    @property
    def whole(self) -> float:
        """The same on the whole guide of the map: of the little that a gentle piece asks for a law leaves most."""
        return max(self.uncompensated, self.map_pp)

    @property
    def still(self) -> bool:
        """Whether the reference asks for nothing: the run is uncompensated."""
        asked = max(self.resolution, self.count, _STILL_SHARE * (self.fit.guide_pp if self.fit else 0.0))
        # Of a map with more than that a short motion may follow a gentle piece; only a centred reference stands still.
        return self.travel <= asked and (self.map_pp <= asked or self.travel == 0.0)

    @cached_property
    def promised(self) -> Promise | None:
        """What the stage was promised; asked for only where the error is more than the encoder's few counts."""
        return self.promise()

    @cached_property
    def largest(self) -> float:
        """Largest error in m, p-p, of a run that is in order; infinite for one that is uncompensated."""
        least = FEW_COUNTS * self.count
        if self.still:
            return math.inf
        if self.pp <= least:
            return least
        if not self.promised:
            return min(max(ACCURATE * self.uncompensated, least), max(self.uncompensated, self.count))
        return max(least, min(ACCURATE * self.whole, self._allowed.pp))

    @cached_property
    def rms(self) -> float:
        """Error in m, RMS about its mean."""
        return float(self.error.std())

    @cached_property
    def largest_rms(self) -> float:
        """The largest RMS likewise: a p-p that single moments of the described strokes have hides an error that lasts.
        Infinite where nothing is promised or the p-p is small, and with stalls, which may make any RMS."""
        known = not self.still and not self.stalls and self.pp > FEW_COUNTS * self.count and self.promised
        return self._allowed.rms if known else math.inf

    @property
    def exceeds(self) -> bool:
        """Whether the error is larger than that of a run in order."""
        return self.pp > self.largest or self.rms > self.largest_rms

    @cached_property
    def _allowed(self) -> Left:
        """By the promise."""
        assert self.promised
        # The error grows at most as the friction. The encoder's noise, and what it rounds, add to both sides.
        counts, noise = (2.0 if self.by_encoder else 1.0) * self.count, self.sensor_noise * self.count
        smooth = self.promised.smooth
        seen = Left(counts + 2.0 * noise * self.by_encoder, _OF_A_COUNT * counts + noise * self.by_encoder)
        allowed = Left(self.friction * smooth.pp + counts + 2.0 * noise, self.friction * smooth.rms + seen.rms)
        if self.pp <= allowed.pp and self.rms <= allowed.rms:
            return allowed
        # Friction's range, and the platform's answer to the noise, are in these strokes.
        drawn = self.promised.largest(Left(self.pp - seen.pp, self.rms - seen.rms)) or Left(0.0, 0.0)
        return Left(max(allowed.pp, drawn.pp + seen.pp), max(allowed.rms, drawn.rms + seen.rms))

    @property
    def largest_of_map(self) -> float:
        """Largest deviation of the guide from the map in m, p-p."""
        noise = math.hypot(self.map_noise, self.fit.noise if self.fit else 0.0)
        return max(_MAP_COUNTS * self.count, _SIGMAS * noise)

    @cached_property
    def strokes(self) -> Sequence[Stroke]:
        """Of the stage; none where its motion is not known."""
        try:
            return motion_of(self.time, self.x).strokes
        except MetricsError:
            return ()

    @cached_property
    def whole_strokes(self) -> Sequence[Stroke]:
        """Those that are as long as the longest, or nearly: a short one shows too little to speak against them."""
        chosen = whole([float(np.ptp(self.x[one.samples])) for one in self.strokes])
        return [one for one, is_whole in zip(self.strokes, chosen.tolist(), strict=True) if is_whole]

    def resting(self) -> list[Array]:
        """The error (m,) in each pause between strokes, from :data:`RESTING` after a stroke on."""
        begins = [int(np.searchsorted(self.time, self.time[one.stop - 1] + RESTING)) for one in self.strokes]
        pauses = zip(begins, self.strokes[1:], strict=False)
        return [self.error[begin : following.start] for begin, following in pauses if begin < following.start]

    def disturbed(self, times: Sequence[Stall]) -> NDArray[np.bool_]:
        """The samples (n,) in any of these times, or so soon after that their error has not decayed yet."""
        mask = np.zeros(self.time.size, dtype=bool)
        for start, end in times:
            begin, stop = np.searchsorted(self.time, (start, end))
            mask[begin : stop + self.recovery] = True
        return mask

    def calm(self, mask: NDArray[np.bool_]) -> float:
        """Error p-p in m without the samples ``mask`` (n,), if that leaves any; with all samples otherwise."""
        return self.pp if mask.all() else peak_to_peak(self.error[~mask])

    @property
    def undisturbed(self) -> float:
        """Error p-p in m without what the stalls of the host disturbed."""
        return self.calm(self.disturbed(self.stalls))

    def judgeable(self, mask: NDArray[np.bool_]) -> bool:
        """Whether the stage travels at least half of its way in the samples without ``mask`` (n,). A small error of
        less than that says nothing of the rest."""
        travelled = np.abs(np.diff(self.x, prepend=self.x[0]))
        return bool(travelled[~mask].sum() >= 0.5 * travelled.sum())

    def harmed(self, mask: NDArray[np.bool_]) -> bool:
        """Whether the error p-p was made in the samples ``mask`` (n,): `HARM` times less, and more than a count less,
        in the others."""
        calm = self.calm(mask)
        return self.pp > HARM * calm and self.pp - calm > self.count


def encoder_count(readings: Array) -> float:
    """The smallest step between two different readings (n,) in m; 0 if all are the same."""
    steps = np.diff(np.unique(readings))
    steps = steps[steps > _COUNTED]
    return float(steps.min()) if steps.size else 0.0
