"""Prints how learning from stroke to stroke lowers the true error, cycle by cycle, in three cases. Each figure is the
median of nine starts (min to max):

stroke      the shipped stroke, commands half a sampling period late
late        the same, commands a whole period late (the amplifier's own 500 Hz come on top, in both)
harmonic    the platform follows 50 µm · sin(2π 0.8 Hz t), as a guide of 125 mm waves that the stage passes at 0.1 m/s
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.cli.options import Values, add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import STARTS, Spread, spreads, values_of_starts
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.straightness.survey import Run, Survey, write_survey

AMPLITUDE, FREQUENCY, SPEED, WAVES = 50e-6, 0.8, 0.1, 4
"""m, Hz, m/s, and waves along the stroke."""


def harmonic(values: Values, folder: Path) -> None:
    """A guide of waves, and a stage that passes them at constant speed."""
    length = WAVES * SPEED / FREQUENCY
    x = np.linspace(0.0, length, round(length / 1e-3) + 1)
    deviation = -AMPLITUDE * np.sin(2.0 * math.pi * FREQUENCY / SPEED * x)
    write_survey(folder / "waves.csv", Survey((Run("1", "forward", x, deviation),)))
    values["driver"]["simulated.truth.guide"] = values["stage"]["guide.file"] = str(folder / "waves.csv")
    values["stage"].update({"motion.start": 0.0, "motion.stroke": length, "motion.speed": SPEED})


def curve(values: Values, cycles: int, starts: int) -> Iterator[tuple[Spread, Spread]]:
    """True error of each cycle in µm: peak to peak, and RMS."""
    values["controller"]["learning.learn"] = True
    simulations = [Simulation(one) for one in values_of_starts(values, starts)]
    for _ in range(cycles):
        found = spreads(evaluate(one.run(), one.map).to_display() for one in simulations)
        yield found["true_pp_um"], found["true_rms_um"]


def main() -> int:
    """Run the cases that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_parameter_options(parser)
    parser.set_defaults(law="smc_observer")
    parser.add_argument("--cycles", type=int, default=11, help="the first one is without a correction (default: 11)")
    parser.add_argument("--starts", type=int, default=STARTS, metavar="N", help="default: %(default)s")
    parser.add_argument("cases", nargs="*", metavar="CASE", help="stroke, late, harmonic (default: all)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        cases = {
            "stroke": lambda values: values["stage"].update({"drive.delay": 0.5}),
            "late": lambda values: values["stage"].update({"drive.delay": 1.0}),
            "harmonic": lambda values: harmonic(values, Path(folder)),
        }
        if set(options.cases) - set(cases):
            parser.error(f"case {options.cases}; allowed: {', '.join(cases)}")
        try:
            for name in options.cases or cases:
                values = chosen_parameters(options)
                cases[name](values)
                print(f"\n{name}, law {options.law}\ncycle   p-p / µm   RMS / µm")
                for number, (pp, rms) in enumerate(curve(values, options.cycles, options.starts), 1):
                    print(f"{number:5d}   {pp.text(3)}   {rms.text(4)}", flush=True)
        except (CommandFailed, ParameterError) as error:
            print(f"{Path(sys.argv[0]).name}: {error}", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
