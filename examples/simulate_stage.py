"""Simulate one cycle of a stage, first as described, then with a platform that is heavier than described.

python examples/simulate_stage.py [STAGE.yaml]
"""

import sys

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.run_verdict import verdict_on
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.parameter_file import shipped_parameters

MASSES = (1.0, 1.2)
"""Mass of the simulated machine, relative to its description; the control law knows the description only."""


def main(stage: str | None = None) -> int:
    # Parameters by node and dotted name, as the parameter file and the stage file have them.
    values = shipped_parameters(stage=stage)
    in_order = True
    for mass in MASSES:
        values["driver"]["simulated.truth.mass"] = mass
        simulation = Simulation(values)
        record = simulation.run()

        # The record has NumPy arrays in s, m and A; `figures` are in SI units too.
        figures = evaluate(record, simulation.map)
        verdict = verdict_on(record, simulation.map, values)
        print(
            f"mass {mass:.1f}: {record.law} leaves {figures.true_pp * 1e6:.3f} µm p-p, {figures.true_rms * 1e6:.4f} µm "
            f"RMS over {figures.samples} samples; straightness {figures.uncompensated_pp * 1e6:.2f} µm before, "
            f"{figures.residual_pp * 1e6:.2f} µm after; {verdict.verdict}"
        )
        in_order = in_order and verdict.in_order
    return 0 if in_order else 1


if __name__ == "__main__":
    try:
        sys.exit(main(*sys.argv[1:]) if len(sys.argv) <= 2 else __doc__)
    except ValueError as refused:  # its message names the file, the parameter, the value and what is allowed
        sys.exit(str(refused))
