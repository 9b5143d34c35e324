"""Our laws beside a controller from `opensmc`, the sliding mode toolbox on PyPI, on the same machine and stroke.

The peer is put together as its documentation does, of its own parts: ClassicalSMC (surface s = c e + ė, equivalent
control with the reference's rate and acceleration) with the reaching law SuperTwisting, and one of its observers for
the velocity, which the encoder does not give. It sees what our laws see: readings of 0.1 µm at 2 kHz, r, ṙ and r̈; its
force goes through our exact inverse of (2), since the toolbox has no magnets, through the same limit, D/A, delay and
amplifier. The toolbox knows of no delay in the loop.

Its gains follow its own source, Levant's k1 = 1.5 √L and k2 = 1.1 L. What is left (c, L and the observer's rate or
bound) was searched by --search: log-uniform draws, judged by the largest error on a short stroke over the three
machines of the table. Our laws run with their shipped parameters, which were not searched on these machines.

Printed as one JSON object: by law and machine the figures of :func:`scripts.law_table.figures_of`, of the whole stroke
forward and back from nine starts.
"""

import argparse
import json
import math
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from scripts.law_table import figures_of
from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.model.actuator import Actuator, control_current
from straightcomp_ros.offline.starts import Values, with_values
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters, node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters
from trials.rig import tracked

INSTALL = (
    "opensmc is not installed: run 'pip install opensmc' in the environment of straightcomp_ros (it needs numpy only)"
)
MACHINES: Mapping[str, tuple[str, dict[str, Any]]] = {
    "nominal": ("driver", {"stage.drive.delay": 0.5}),
    "delay of one sample": ("driver", {"stage.drive.delay": 1.0}),
    "mass −20 %": ("driver", {"stage.drive.delay": 0.5, "simulated.truth.mass": 0.8}),
}
"""What the peer and our laws run on: node and parameters that differ from the shipped file. No law is told of it."""
SHORT = {"motion.stroke": 0.3, "motion.settle": 0.3, "motion.pause": 0.2}


class Design(NamedTuple):
    """c in 1/s; L in m/s³; rate in 1/s of the extended state observer, or bound in m/s² of Levant's differentiator."""

    surface: float
    disturbance_rate: float
    observer: float


DESIGNS = {
    "opensmc, ESO": Design(956.0, 31.4, 464.0),
    "opensmc, Levant": Design(439.0, 3.26, 1.24),
}
"""As found by --search 60."""
RANGES = {
    "opensmc, ESO": ((200.0, 1500.0), (5.0, 100.0), (200.0, 500.0)),
    "opensmc, Levant": ((200.0, 1000.0), (2.0, 20.0), (1.0, 5.0)),
}
"""Of a search, (lowest, highest) of each number of a design."""


class Peer:
    """The toolbox's parts, wired together; what it knows of the plant is what our laws know.

    Args:
        name: of `DESIGNS`; says which observer.
        design: its gains.
        stage: as described.
        y: position in m at which everything starts, at rest.
    """

    def __init__(self, name: str, design: Design, stage: StageParameters, y: float) -> None:
        from opensmc.controllers import ClassicalSMC
        from opensmc.estimators import ExtendedStateObserver, LevantDifferentiator
        from opensmc.reaching import SuperTwisting

        rate, period, mass = design.disturbance_rate, stage.period, stage.platform.mass
        reaching = SuperTwisting(k1=1.5 * math.sqrt(rate), k2=1.1 * rate, dt=period)
        self._controller = ClassicalSMC(reaching=reaching, c=design.surface, J=mass)
        self._observer: Any
        self._velocity: Callable[[], float]
        if name == "opensmc, ESO":
            self._observer = ExtendedStateObserver(epsilon=1.0 / design.observer, b_input=1.0 / mass, dt=period)
            self._velocity = lambda: self._observer.state_estimates[1]
        else:
            self._observer = LevantDifferentiator(order=1, L=design.observer, dt=period)
            self._velocity = lambda: self._observer.derivatives[1]
        self._actuator: Actuator = stage.actuator.constants()
        self._limit = stage.actuator.current_limit
        self._start = y
        self._force = 0.0

    def step(self, y: float, r: float, r_dot: float, r_ddot: float) -> Command:
        """One sample."""
        # Its observers start at zero.
        self._observer.estimate(0.0, None, self._force, y=y - self._start)
        velocity = float(self._velocity())
        force, told = self._controller.compute(0.0, (y, velocity), (r, r_dot, r_ddot))
        self._force = float(force)
        asked = control_current(self._actuator, y, self._force)
        current = max(-self._limit, min(self._limit, asked))
        return Command(current, r - y, float(told["s"]), asked, 0.0, velocity, math.nan)


def peer_law(name: str, design: Design, values: Values) -> Law:
    """The peer as a law: its state is the peer itself, made anew at each start."""
    controller: ControllerNodeParameters = node_parameters("controller", values)

    def start(y: float) -> Peer:
        return Peer(name, design, controller.stage, y)

    def step(gains: tuple[()], peer: Peer, y: float, r: float, r_dot: float, r_ddot: float, current: float) -> Any:
        return peer, peer.step(y, r, r_dot, r_ddot)

    # Its constants are in the peer itself.
    return Law((), start, step)


def search(name: str, values: Values, draws: int) -> tuple[Design, float]:
    """The best of ``draws`` designs, and its largest error in µm over the machines on the short stroke."""
    random = np.random.default_rng(1)
    short = with_values(values, "stage", SHORT)
    best, least = DESIGNS[name], math.inf
    tried = [Design(*(math.exp(random.uniform(*np.log(ends))) for ends in RANGES[name])) for _ in range(draws)]
    for design in tracked([best, *tried], f"searching {name}"):
        worst = 0.0
        for node, changes in MACHINES.values():
            try:
                machine = with_values(short, node, changes)
                worst = max(worst, figures_of(machine, peer_law(name, design, machine), starts=1)["pp_um"]["max"])
            except (MetricsError, FloatingPointError, OverflowError, ZeroDivisionError, ValueError):
                worst = math.inf  # the loop ran away
            if worst >= least:
                break
        if worst < least:
            best, least = design, worst
    return best, least


def compare(values: Values) -> dict[str, dict[str, dict[str, Any]]]:
    """Figures by law and machine: ours first, then the peer's."""
    found = defaultdict[str, dict[str, dict[str, Any]]](dict)
    for law in tracked((*LAWS, *DESIGNS), "laws"):
        for machine, (node, changes) in MACHINES.items():
            varied = with_values(values, node, changes)
            if law in DESIGNS:
                found[law][machine] = figures_of(varied, peer_law(law, DESIGNS[law], varied))
            else:
                found[law][machine] = figures_of(with_values(varied, "controller", {"control.law": law}))
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run the comparison, or the search for the peer's gains."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--search", type=int, metavar="N", help="draw N designs of each peer instead, print the best")
    options = parser.parse_args(arguments)
    try:
        import opensmc  # noqa: F401
    except ImportError:
        print(INSTALL, file=sys.stderr)
        return 2
    values = shipped_parameters()
    if options.search is not None:
        for name in DESIGNS:
            best, least = search(name, values, options.search)
            print(f"{name}: {best}, {least:.3f} µm")
        return 0
    print(json.dumps({"laws": compare(values)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
