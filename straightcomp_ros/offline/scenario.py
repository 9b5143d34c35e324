"""How a stroke is set up offline: from the parameters of the nodes to what a law is given at each sample; and one cycle
of the stage as a compiled loop over the law's own step function and the plant's own.

`node_set` reads the parameters, for the simulation of the nodes too. A scenario holds what strokes and sweeps take from
them; its stroke is the motion as all but the platform see it, and its cycle is the platform's answer. The compiled loop
gives, bit for bit, what :class:`straightcomp_ros.offline.simulation.Simulation` gives under the same conditions, some
ten times faster: references are computed beforehand, since the stage's motion does not depend on the platform.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.pairing import extrapolated
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.compiled import Compiled, compiled, is_ours
from straightcomp_ros.model.converters import nearest_count
from straightcomp_ros.model.motion import Trajectory, forward_and_back
from straightcomp_ros.model.plant import (
    BIAS,
    PLACE,
    READING,
    Hold,
    PlantParameters,
    advance_to_sample,
    commanded_plant,
    plant_state,
)
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import (
    CellNodeParameters,
    ControllerNodeParameters,
    DriverNodeParameters,
    FeedforwardNodeParameters,
    Values,
    node_parameters,
)
from straightcomp_ros.stage.description import Factors, StageParameters, deviating
from straightcomp_ros.straightness.feedforward import FeedforwardParameters, along, continues, rates, restarted, updated
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_survey, map_of
from straightcomp_ros.straightness.survey import Survey

_SHIPPED_HOLD = SimulatedParameters().hold(StageParameters())
_AT_REST = plant_state()


class Cycle(NamedTuple):
    """True y and the encoder's y in m, the commanded control current in A and the coils' in A, (samples,) each.

    Shorter than its conditions if a current of the law or the platform's position was not finite.
    """

    true_y: NDArray[np.float64]
    y: NDArray[np.float64]
    current: NDArray[np.float64]
    coil_current: NDArray[np.float64]


def run_cycle(
    law: Law,
    plant: PlantParameters,
    stamps: NDArray[np.int64],
    delays: NDArray[np.int64],
    references: NDArray[np.float64],
    noise: NDArray[np.float64] | None = None,
    x: NDArray[np.float64] | None = None,
    initial: NDArray[np.float64] = _AT_REST,
    hold: Hold = _SHIPPED_HOLD,
) -> Cycle:
    """Run one cycle with the amplifier on from the first sample, as `Simulation` does.

    The law starts at rest at its first reading. The time limits of amplifier, board and `Servo` for late commands and
    lost samples are not modelled.

    Args:
        law: its functions must be `compilable`.
        plant: the machine.
        stamps: time of each sample in ns, (n,) int64; the first is 0, and they rise.
        delays: time from each sample until its command takes effect, in ns, (n,) int64, zero or more. A command never
            overtakes the one before: it then takes effect together with it, and replaces it.
        references: (n, 3) r in m, ṙ in m/s, r̈ in m/s² for the law.
        noise: (n,) added to the position y before the encoder rounds, m; none by default.
        x: (n,) true position of the stage in m, which only disturbances ask for; by default it stays at 0.
        initial: state of the plant, of which the forces are not read.
        hold: how the board holds the platform when the next command is late.
    """
    count = stamps.size
    found = np.empty((len(Cycle._fields), count))
    machine = commanded_plant(plant, hold, initial)
    machine.state[BIAS] = plant.actuator.bias_current
    noise, x = (np.zeros(count) if one is None else one for one in (noise, x))
    # At the first sample nothing has moved yet: this reading is the one that the loop takes again.
    advance_to_sample(*machine, stamps[:0], noise[:0], 0, 0, noise[0], x[0])
    first = float(machine.state[READING])
    done = kernel(law.function)(
        *machine,
        stamps,
        np.maximum.accumulate(stamps + delays),
        references,
        noise,
        x,
        law.gains,
        law.start(first),
        *found,
    )
    return Cycle(*found[:, :done])


@cache
def kernel(step: Callable[..., Any]) -> Callable[..., int]:
    """The compiled loop around a law's step function, compiled once in a process and cached on disk."""

    def loop(  # type: ignore[no-untyped-def]
        constants, state, times, stamps, effective, references, noise, x, gains, law_state, true_y, y, current, coil
    ):
        """Samples done."""
        taken = 0
        for k in range(stamps.size):
            waiting, asked = effective[taken:], current[taken:]
            taken += advance_to_sample(constants, state, times, waiting, asked, k - taken, stamps[k], noise[k], x[k])
            if not math.isfinite(state[0]):
                return k
            true_y[k], y[k], coil[k] = state[PLACE], state[READING], state[3]
            law_state, answer = step(
                gains, law_state, y[k], references[k, 0], references[k, 1], references[k, 2], coil[k]
            )
            if not math.isfinite(answer.current):
                return k
            current[k] = answer.current
        return stamps.size

    return Compiled(loop, cached=is_ours(step))


MOST_SAMPLES = 20_000_000
"""Of a cycle: they are in memory at once, some 3 GB."""


class NodeSet(NamedTuple):
    """Parameters of the simulated nodes."""

    driver: DriverNodeParameters
    feedforward: FeedforwardNodeParameters
    controller: ControllerNodeParameters
    cell: CellNodeParameters

    @property
    def trajectory(self) -> Trajectory:
        """Motion of the stage, one cycle."""
        return Trajectory(forward_and_back(self.cell.stage.motion))

    def check_rates(self) -> None:
        """Raise ParameterError if controller and machine disagree about the rate."""
        rate, machine = self.controller.stage.rate, self.driver.stage.rate
        if rate != machine:
            raise ParameterError(
                f"node controller: parameter 'stage.rate': {rate} Hz; allowed: {machine} Hz, as the driver has"
            )


def node_set(values: Values) -> NodeSet:
    """The parameters of the simulated nodes; ParameterError if one is refused."""
    return NodeSet(*(node_parameters(node, values) for node in NodeSet._fields))


class Stroke(NamedTuple):
    """One motion of the stage; all arrays (n,), one entry for each sample.

    Attributes:
        stamps: ns; the first is 0.
        true_x, x: of the slider in m, and as its encoder reads it.
        map: of the guide.
        references: (n, 3) r in m, ṙ in m/s and r̈ in m/s² of the feedforward.
        given: (n, 3) the same as the law gets them.
    """

    stamps: NDArray[np.int64]
    true_x: NDArray[np.float64]
    x: NDArray[np.float64]
    map: StraightnessMap
    references: NDArray[np.float64]
    given: NDArray[np.float64]

    def record(self, time: NDArray[np.float64], cycle: Cycle, guide: NDArray[np.float64], law: str) -> StrokeRecord:
        """The record of a cycle along it under the law of this name; times (n,) in s, and the true guide (n,) in m."""
        return StrokeRecord(
            time=time,
            x=self.x,
            y=cycle.y,
            r=self.references[:, 0].copy(),
            current=cycle.current,
            law=law,
            true_x=self.true_x,
            true_y=cycle.true_y,
            guide=guide,
        )


@dataclass(frozen=True, eq=False)
class Scenario:
    """A stroke, or a sweep without its seed: self-contained, so that it can be sent to a worker that has no files.

    The guide is left out: the error under r(x) does not depend on how straight the guide truly is.

    Attributes:
        driver: the simulated machine.
        description: of the stage, as the controller has it.
        controls: parameters of each law, by its name.
        feedforward: tracking of the stage.
        followed: description of the stage, as the feedforward has it.
        lead_ns: how much older than a sample its reference is, in ns.
        trajectory: motion of the stage, one cycle.
        survey: the measurement for the controller's map.
    """

    driver: DriverNodeParameters
    description: StageParameters
    controls: Mapping[str, ControlParameters]
    feedforward: FeedforwardParameters
    followed: StageParameters
    lead_ns: int
    trajectory: Trajectory
    survey: Survey

    def on(self, stage: StageParameters) -> Scenario:
        """The same on another stage: all have its description."""
        driver = dataclasses.replace(self.driver, stage=stage)
        return dataclasses.replace(self, description=stage, followed=stage, driver=driver)

    def in_time(self) -> Scenario:
        """The same with references as new as the stage's motion asks for; its controller needs this lead too."""
        lead = self.followed.enough_lead(map_of(self.survey, self.followed.guide), self.lead_ns / 1e9)
        return dataclasses.replace(self, lead_ns=round(lead * 1e9))

    @property
    def samples(self) -> int:
        """Samples of a cycle."""
        return -(-self.trajectory.end_ns // self.description.period_ns)

    def stroke(self, stamps: NDArray[np.int64] | None = None, survey: Survey | None = None) -> Stroke:
        """A cycle with samples at ``stamps`` in ns, by default on the grid, and a map by ``survey``, by default by its
        own; SurveyError if the survey gives no map within the platform's travel."""
        if stamps is None:
            stamps = np.arange(self.samples, dtype=np.int64) * self.description.period_ns
        straightness = map_of(survey or self.survey, self.followed.guide)
        zero = self.driver.simulated.index_shift
        true_x = self.trajectory.shifted(zero).at(stamps)
        x = readings(self.driver.stage.encoder.x_resolution, true_x - zero)
        tracking = self.followed.tracking(self.feedforward, straightness)
        found = references(straightness, tracking, self.followed, stamps, x)
        # As `Pairing` gives them to the law: extrapolated from those of the lead before each sample.
        earlier = np.searchsorted(stamps, np.maximum(stamps - self.lead_ns, stamps[0]), side="right") - 1
        given = np.column_stack(extrapolated(*found[earlier].T, (stamps - stamps[earlier]) * 1e-9))
        return Stroke(stamps, true_x, x, straightness, found, given)

    def cycle(
        self,
        law: Law,
        stroke: Stroke,
        delays: float | NDArray[np.int64] | None = None,
        noise: NDArray[np.float64] | None = None,
        plant: PlantParameters | None = None,
        offset: float = 0.0,
    ) -> Cycle:
        """The platform during a stroke; it is shorter than the stroke if a current or a position was not finite.

        Args:
            law: of the scenario, or another compilable one.
            stroke: of the scenario.
            delays: of all commands in sampling periods, or of the first ones in ns; the stage's by default, and of all
                others.
            noise: (n,) added to y before the encoder rounds, m.
            plant: the machine, by default the scenario's.
            offset: of the platform's first position from that of the parameters, m.
        """
        own = delays if isinstance(delays, float) else self.driver.stage.drive.delay
        late = np.full(stroke.stamps.size, round(own * self.description.period_ns))
        if isinstance(delays, np.ndarray):
            late[: delays.size] = delays[: late.size]
        given = stroke.stamps, late, stroke.given, noise, stroke.true_x
        initial = plant_state(y=self.driver.simulated.initial_y + offset)
        return run_cycle(law, plant or self.driver.plant, *given, initial, self.driver.hold)


def make_scenario(values: Values, laws: Sequence[str]) -> Scenario:
    """The scenario under the parameters of the nodes, as `Simulation` takes them.

    Args:
        values: parameters by node and dotted name.
        laws: names of the laws; all run on the same machines. `control.law` is not read.

    Raises:
        ParameterError: a parameter is refused, rates differ, or a machine within the ranges is impossible.
        SurveyError: the survey is refused.
    """
    controls = {}
    for law in laws:
        nodes = node_set({**values, "controller": {**values.get("controller", {}), "control.law": law}})
        nodes.check_rates()
        controls[law] = nodes.controller.control
    driver, feedforward, controller, _ = nodes
    stage, uncertainty = controller.stage, controller.stage.uncertainty
    deviating(driver.plant, Factors(air_gap=1.0 - uncertainty.air_gap))
    # The oldest command on the board is a period and twice the jitter old, even if it acts at once.
    oldest = stage.period * (1.0 + 2.0 * uncertainty.jitter)
    if driver.simulated.command_timeout < oldest:
        raise ParameterError(
            f"node driver: parameter 'simulated.command_timeout': {driver.simulated.command_timeout!r} s; "
            f"allowed in a sweep: >= {oldest:.4g} s, a period and twice the jitter"
        )
    trajectory = nodes.trajectory
    if trajectory.end_ns > MOST_SAMPLES * stage.period_ns:
        raise ParameterError(
            f"parameters 'stage.motion.*': a cycle of {trajectory.end_ns * 1e-9:.3g} s has "
            f"{trajectory.end_ns / stage.period_ns:.3g} samples; allowed offline: <= {MOST_SAMPLES}"
        )
    return Scenario(
        driver=driver,
        description=stage,
        controls=controls,
        feedforward=feedforward.feedforward,
        followed=feedforward.stage,
        lead_ns=controller.lead_ns,
        trajectory=trajectory,
        survey=load_survey(feedforward.stage.guide),
    )


def laws_of(scenario: Scenario) -> dict[str, Law]:
    """The scenario's laws, ready to run."""
    return {law: make_law(control, scenario.description) for law, control in scenario.controls.items()}


@compiled
def readings(resolution: float, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Readings of an encoder of ``resolution`` (m) at ``positions``, (n,) in m."""
    seen = np.empty_like(positions)
    for k in range(positions.size):
        seen[k] = nearest_count(resolution, positions[k])
    return seen


@compiled
def _follow(bandwidth, gap_ns, max_speed, noise, stamps, x, v, a):  # type: ignore[no-untyped-def]
    tracked = restarted(x[0])
    v[0], a[0] = tracked.v, tracked.a
    for k in range(1, x.size):
        elapsed = stamps[k] - stamps[k - 1]
        if continues(gap_ns, max_speed, noise, elapsed, x[k] - x[k - 1]):
            tracked = updated(bandwidth, tracked, elapsed * 1e-9, x[k])
        else:
            tracked = restarted(x[k])
        v[k], a[k] = tracked.v, tracked.a


def references(
    straightness: StraightnessMap,
    parameters: FeedforwardParameters,
    stage: StageParameters,
    stamps: NDArray[np.int64],
    x: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The references of a whole cycle at once, bit for bit those of `Feedforward.step`, by the same functions.

    r in m, ṙ in m/s and r̈ in m/s², (n, 3), at ``stamps``, (n,) in ns, all different, and ``x``, (n,) in m.
    """
    v, a = np.empty_like(x), np.empty_like(x)
    limits = stage.motion.highest_speed, stage.encoder.x_noise
    _follow(parameters.bandwidth, parameters.restart_gap_ns, *limits, stamps, x, v, a)
    r, slope, curvature = along(straightness, x)
    return np.column_stack([r, *rates(slope, curvature, v, a)])
