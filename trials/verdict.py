"""Measure how often the verdict accuses a sound run, and which cause it names of runs with one.

Runs are strokes of the stages of test/stages with their designed gains, of random place, length, speed and pauses. The
machine is as an identification leaves it: mass, magnets, gap and friction within a quarter of the described
uncertainty. The encoder has noise, the survey that of the description, the samples jitter, and on a loaded computer up
to one command in a hundred is late by up to a period.

An unsound run has one cause in addition, drawn until it leaves at least `WORSE` times what the same run leaves without
it, and more than the encoder's counts: less is no fault that anyone could see. Runs that end at the stop are left out:
their verdict says no cause.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator, default_rng

from scripts.design_table import found_gains
from scripts.stage_files import stage_names, stage_values
from straightcomp_ros.analysis.judgement import AT_STOP, Verdict
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.analysis.run_verdict import verdict_on
from straightcomp_ros.cli.options import in_range
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.offline.scenario import laws_of, make_scenario
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.tuning.design.gains import closed_form
from straightcomp_ros.tuning.sweep.trial import mismeasured, sample_times
from trials.rig import tracked

SUMMARY = "false alarms, missed faults and named causes of the verdict"
WORSE, COUNTS = 4.0, 4.0
"""Least effect of a cause: relative to the run without it, and in counts of the encoder, p-p."""
_ATTEMPTS = 6
_IDENTIFIED = 0.25
"""Part of the described uncertainty in which a machine lies after its identification."""
_TRUTH = "simulated.truth."
_LAW = "smc_observer"


class Drawn(NamedTuple):
    """A run to simulate: parameters, the survey of its map with the noise in it, and what is random while it runs."""

    values: dict[str, dict[str, Any]]
    survey: Survey
    seed: int
    late: float  # share of the commands that are late

    @property
    def stage(self) -> StageParameters:
        """As it is described."""
        return make_scenario(self.values, [_LAW]).description

    @property
    def dry(self) -> float:
        """Coulomb friction in N, or a hundredth of the mass without any: the measure of a force that matters."""
        return max(self.stage.friction.coulomb, 1e-2 * self.stage.platform.mass)

    def row(self, number: int, verdict: Verdict) -> dict[str, Any]:
        """The verdict on run ``number`` of a draw, to print."""
        return {"run": number, "stage": self.values["stage"]["name"], **verdict._asdict()}

    def of(self, node: str, changes: Mapping[str, Any]) -> Drawn:
        """The run with changes of parameters of a node."""
        return self._replace(values=with_values(self.values, node, changes))

    def true(self, prefix: str = "", **changes: Any) -> Drawn:
        """The run with changes of the machine's truth, whose names begin with ``prefix``."""
        return self.of("driver", {f"{_TRUTH}{prefix}{name}": value for name, value in changes.items()})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add, count = parser.add_argument, in_range(int, 0)
    add("--sound", type=count, default=50, metavar="N", help="sound runs (default: %(default)s)")
    add("--unsound", type=count, default=2, metavar="N", help="unsound runs of each cause (default: %(default)s)")
    add("--seed", type=int, default=1, metavar="N", help="of all that is drawn (default: %(default)s)")


def run(options: argparse.Namespace) -> None:
    """Print the sound runs that were accused, how each cause was named, and the runs in which another one was."""
    accused, table, others = [], {cause: Counter[str]() for cause in CAUSES}, []
    for number in tracked(range(options.sound), "sound runs"):
        drawn = sound(default_rng([options.seed, 0, number]))
        verdict = verdict_on(*simulated(drawn), drawn.values)
        if not verdict.in_order:
            accused.append(drawn.row(number, verdict))
    for place, cause in enumerate(tracked(CAUSES, "unsound runs"), 1):
        for number in range(options.unsound):
            found = unsound(default_rng([options.seed, place, number]), CAUSES[cause])
            if found is not None:
                rightly = re.search(NAMED[cause], str(found[1]))
                table[cause]["rightly" if rightly else found[1].verdict] += 1
                if not rightly:
                    others.append({"cause": cause, **found[0].row(number, found[1])})
    print_json({"sound": options.sound, "accused": accused, "named_by_cause": table, "others": others})


def sound(random: Generator) -> Drawn:
    """A run of a stage as identified."""
    name = str(random.choice([name for name in stage_names() if name != "infeasible"]))
    values = stage_values(name)
    scenario = make_scenario(values, [_LAW])
    values["controller"] |= found_gains().get(name) or closed_form(scenario, _LAW)
    stage = scenario.description
    length = stage.motion.stroke * random.uniform(0.15, 0.6)
    values["stage"] |= {
        "motion.stroke": length,
        "motion.start": stage.motion.start + random.uniform(0.0, stage.motion.stroke - length),
        "motion.speed": stage.motion.speed * random.uniform(0.3, 1.0),
        "motion.settle": random.uniform(0.3, 1.0),
        "motion.pause": random.uniform(0.3, 0.8),
    }
    ranges = stage.uncertainty
    for fact in ("mass", "force", "air_gap"):
        values["driver"][_TRUTH + fact] = 1.0 + _IDENTIFIED * getattr(ranges, fact) * random.uniform(-1.0, 1.0)
    values["driver"][_TRUTH + "friction"] = ranges.friction ** (_IDENTIFIED * random.uniform(-1.0, 1.0))
    values["driver"]["simulated.initial_y"] = stage.encoder.y_resolution * random.uniform(-5.0, 5.0)
    # The guide is the survey without noise; the map has it with noise.
    values["driver"][_TRUTH + "guide"] = stage.guide.file
    survey = mismeasured(scenario.survey, stage.uncertainty.map_noise, random)
    return Drawn(values, survey, int(random.integers(2**31)), float(random.choice([0.0, 0.001, 0.01])))


def simulated(drawn: Drawn) -> tuple[StrokeRecord, StraightnessMap]:
    """The run, and the map that it followed; ValueError if the platform is lost."""
    scenario = make_scenario(drawn.values, [_LAW])
    random, stage = default_rng(drawn.seed), scenario.description
    stamps = sample_times(stage.uncertainty.jitter * stage.period, stage.period_ns, scenario.samples, random)
    noise = stage.encoder.y_resolution * stage.uncertainty.sensor_noise * random.uniform()
    delays = np.full(stamps.size, round(scenario.driver.stage.drive.delay * stage.period_ns))
    late = np.flatnonzero(random.random(stamps.size) < drawn.late)
    delays[late] += random.integers(0, stage.period_ns, late.size)
    stroke = scenario.stroke(stamps, drawn.survey)
    (law,) = laws_of(scenario).values()
    cycle = scenario.cycle(law, stroke, delays, noise * random.standard_normal(stamps.size))
    if cycle.y.size < stamps.size:
        raise ValueError("the platform is lost")
    guide = scenario.driver.guide().deviations(stroke.true_x)
    return stroke.record(stamps * 1e-9, cycle, guide, _LAW), stroke.map


Spoil = Callable[[Drawn, Generator], Drawn]


def unsound(random: Generator, spoil: Spoil) -> tuple[Drawn, Verdict] | None:
    """A run with the cause, and the verdict on it; None if the cause did nothing on `_ATTEMPTS` runs."""
    for _ in range(_ATTEMPTS):
        drawn = sound(random)
        count, spoilt = drawn.stage.encoder.y_resolution, spoil(drawn, random)
        try:
            found = simulated(spoilt)
            before, after = evaluate(*simulated(drawn)), evaluate(*found)
            effects = [(before.true_pp or 0.0, after.true_pp or 0.0), (before.residual_pp, after.residual_pp)]
            verdict = verdict_on(*found, spoilt.values)
            worse = any(spoilt_pp > max(WORSE * own, own + COUNTS * count) for own, spoilt_pp in effects)
            if worse and verdict.verdict != AT_STOP:
                return spoilt, verdict
        except ValueError:
            continue
    return None


def _another_guide(change: Callable[[Any, Any, Generator], tuple[Any, Any]]) -> Spoil:
    """The map is made from a survey that was ``change``\\ d: x and deviation of each run, in m, all alike."""

    def spoil(drawn: Drawn, random: Generator) -> Drawn:
        state, runs = random.bit_generator.state, []
        for one in drawn.survey.runs:
            random.bit_generator.state = state
            runs.append(Run(one.name, one.direction, *change(one.x, one.deviation, random)))
        return drawn._replace(survey=Survey(tuple(runs)))

    return spoil


def _shifted(x: Any, deviation: Any, random: Generator) -> Any:
    # The survey must still hold the stroke.
    by = random.uniform(1e-3, 1e-2) * float(random.choice([-1.0, 1.0]))
    return x, np.interp(x + by, x, deviation)


def _sparse(x: Any, deviation: Any, random: Generator) -> Any:
    count = max(10, round(float(np.ptp(x)) / random.uniform(0.03, 0.1)))
    rows = np.unique(np.linspace(0, x.size - 1, count).astype(int))
    return x[rows], deviation[rows]


def _bowed(x: Any, deviation: Any, random: Generator) -> Any:
    along = 2.0 * (x - x.min()) / np.ptp(x) - 1.0
    return x, deviation + random.uniform(0.1, 0.5) * np.ptp(deviation) * along**2


def _noisy(drawn: Drawn, random: Generator) -> Drawn:
    (one, *_), step = drawn.survey.runs, float(random.choice([0.5e-3, 1e-3]))
    x = np.arange(one.x.min(), one.x.max(), step)
    noise = random.uniform(0.1e-6, 0.5e-6) * random.standard_normal(x.size)
    survey = Survey((Run("1", "forward", x, np.interp(x, one.x, one.deviation) + noise),))
    return drawn._replace(survey=survey).of("stage", {"guide.smooth": "none"})


def _sticky(drawn: Drawn, random: Generator) -> Drawn:
    drawn = drawn.true("contact.", model="maxwell_slip")
    drawn = drawn.true("contact.maxwell_slip.", blocks=1, attraction=1e9)
    stiffness = float(10.0 ** random.uniform(7.5, 8.5))
    static = drawn.stage.friction.coulomb * random.uniform(1.5, 2.0)
    return drawn.of("driver", {"stage.friction.bristle_stiffness": stiffness, "stage.friction.static": static})


def _of_loop(drawn: Drawn, random: Generator) -> Drawn:
    if random.uniform() < 0.5:
        return drawn.true(mass=random.uniform(2.5, 5.0))
    return drawn.of("driver", {"stage.drive.delay": drawn.stage.drive.delay + random.uniform(2.0, 5.0)})


def _mode(drawn: Drawn, random: Generator) -> Drawn:
    frequency = random.uniform(60.0, min(600.0, 0.3 * drawn.stage.rate))
    mode = {"frequency": frequency, "damping": random.uniform(0.005, 0.03), "coil": 1.0}
    mode["encoder"] = float(random.choice([-1.0, 1.0]))
    drawn = drawn.true("modes.first.", **mode)
    # Described, so that the verdict can know it; the gains are not designed for it.
    return drawn.of("controller", {f"stage.platform.modes.first.{name}": value for name, value in mode.items()})


CAUSES: Mapping[str, Spoil] = {
    "shift": _another_guide(_shifted),
    "sign": _another_guide(lambda x, deviation, random: (x, -deviation)),
    "bow": _another_guide(_bowed),
    "points": _another_guide(_sparse),
    "noise": _noisy,
    "mains": lambda drawn, random: drawn.true(
        "disturbances.mains.",
        frequency=float(random.choice([50.0, 60.0])) + random.uniform(-0.1, 0.1),
        force=random.uniform(0.5, 3.0) * drawn.dry,
        second=random.uniform(0.0, 0.2) * drawn.dry,
    ),
    "cogging": lambda drawn, random: drawn.true(
        "disturbances.cogging.", force=random.uniform(1.0, 5.0) * drawn.dry, pitch=random.uniform(0.008, 0.032)
    ),
    "drift": lambda drawn, random: drawn.true(
        "disturbances.drift.",
        current=random.uniform(1.0, 5.0) * drawn.dry / drawn.stage.actuator.current_stiffness,
        time=random.uniform(0.3, 2.0),
    ).true("disturbances.", seed=int(random.integers(1000))),
    "vibration": lambda drawn, random: drawn.true(
        "disturbances.vibration.",
        acceleration=random.uniform(0.5, 3.0) * drawn.dry / drawn.stage.platform.mass,
        frequency=10.0 ** random.uniform(1.0, 2.3),
        damping=random.uniform(0.01, 0.1),
    ).true("disturbances.", seed=int(random.integers(1000))),
    "stiction": _sticky,
    "friction": lambda drawn, random: drawn.true(friction=random.uniform(20.0, 60.0)),
    "loop": _of_loop,
    "mode": _mode,
}
"""What spoils a run, by name."""
NAMED = {
    "shift": "zero of x is off",
    "sign": "opposite sign",
    "bow": "bowed",
    "points": "more points",
    "noise": "repeat its runs",
    "mains": "^mains:",
    "cogging": "learning.learn",
    "drift": "offset of the amplifier that drifts",
    "vibration": "^vibration:",
    "stiction": "^stick slip:|friction is not as described",
    "friction": "^stick slip:|friction is not as described",
    "loop": "^oscillates:",
    "mode": "^resonance:",
}
"""A pattern of the verdict that names a cause."""
