"""Machines that are drawn blindly, each commissioned without a look at the truth, beside what full knowledge gives.

    python -m scripts.blind_trials STAGE --machines 50 --seed 1 -o DIR

All is drawn within `stage.uncertainty`, friction and amplifier log-uniformly, and the encoder's count log-uniformly
from 0.05 to 0.5 µm. Full knowledge is the same design with the same effort, from a description that is the machine.
Figures are of the true error, medians of three starts. A row is printed as soon as it is known; a machine that DIR has
already is not repeated.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.run_verdict import judged_run
from straightcomp_ros.commissioning.procedure import Procedure
from straightcomp_ros.commissioning.simulated_machine import SimulatedMachine
from straightcomp_ros.configuration.node_parameters import Values, by_node, node_parameters
from straightcomp_ros.configuration.parameter_file import shipped_parameters
from straightcomp_ros.design.automatic_design import design_gains
from straightcomp_ros.design.feasible_gains import DesignError
from straightcomp_ros.offline.sweep.scenario import make_scenario
from straightcomp_ros.offline.sweep.starts import runs_of_starts, spread
from straightcomp_ros.settings.whole_file import write_whole
from straightcomp_ros.stage.description import StageParameters

STARTS = 3
COUNTS = (0.05e-6, 0.5e-6)
LAW = "smc_observer"
WITHIN = 1.25


def drawn(stage: StageParameters, seed: int, number: int) -> tuple[dict[str, float], float]:
    """Values of the driver for machine ``number``, and its encoder's count in m."""
    ranges, u = stage.uncertainty, np.random.default_rng([seed, number]).random(7).tolist()
    truth = {
        "mass": 1.0 + ranges.mass * (2.0 * u[0] - 1.0),
        "force": 1.0 + ranges.force * (2.0 * u[1] - 1.0),
        "air_gap": 1.0 + ranges.air_gap * (2.0 * u[2] - 1.0),
        "friction": ranges.friction ** (2.0 * u[3] - 1.0),
        "amplifier": ranges.amplifier ** (2.0 * u[4] - 1.0),
    }
    late = ranges.shortest_delay + (ranges.longest_delay - ranges.shortest_delay) * u[5]
    machine = {f"simulated.truth.{name}": value for name, value in truth.items()}
    count = COUNTS[0] * (COUNTS[1] / COUNTS[0]) ** u[6]
    return {**machine, "stage.drive.delay": late * stage.drive.delay}, count


def with_full_knowledge(values: Values) -> dict[str, dict[str, Any]]:
    """The parameters with a description that is the machine, and as well known as after an identification."""
    driver = node_parameters("driver", values)
    plant = driver.plant
    facts = {
        "platform.mass": plant.platform.mass,
        "actuator.pole_area": plant.actuator.pole_area,
        "actuator.air_gap": plant.actuator.air_gap,
        "friction.coulomb": plant.friction.coulomb,
        "friction.static": plant.friction.static,
        "friction.viscous": plant.friction.viscous,
        "drive.bandwidth": plant.drive.bandwidth,
        "drive.delay": driver.stage.drive.delay,
        "uncertainty.mass": 0.02,
        "uncertainty.force": 0.05,
        "uncertainty.air_gap": 0.02,
        "uncertainty.friction": 1.3,
        "uncertainty.amplifier": 1.05,
        "uncertainty.shortest_delay": 0.9,
        "uncertainty.longest_delay": 1.1,
    }
    own = {name: v for name, v in values["driver"].items() if not name.startswith(("simulated.truth.", "stage."))}
    described = {node: dict(section) for node, section in values.items()}
    return {**described, "stage": {**described["stage"], **facts}, "driver": own}


def figures(values: Values) -> tuple[float, str]:
    """Median true peak-to-peak error in µm over the starts, and the worst verdict."""
    found, verdicts = [], []
    for record, straightness in runs_of_starts(values, STARTS):
        found.append((evaluate(record, straightness).true_pp or math.nan) * 1e6)
        verdicts.append(judged_run(record, straightness, by_node(values), straightness).verdict)
    bad = [verdict for verdict in verdicts if verdict != "in_order"]
    return spread(found).median, bad[0] if bad else "in_order"


def trial(values: Values, folder: Path, evaluations: int, machines: int) -> dict[str, Any]:
    """Commission one machine, and design it with full knowledge."""
    procedure = Procedure(SimulatedMachine(values), values, folder, evaluations=evaluations, machines=machines)
    for step in procedure.remaining():
        outcome = procedure.run(step)
        if not outcome.passed:
            return {"failed": step, "sentence": outcome.sentence}
    work = procedure.work("certificate")
    tuned = {**work.values, "driver": SimulatedMachine(values).parameters}
    known = with_full_knowledge(values)
    try:
        best = design_gains(make_scenario(known, [LAW]), LAW, evaluations=evaluations, machines=machines, jobs=1)
    except DesignError as error:
        return {"failed": "full knowledge", "sentence": str(error)}
    ideal = {**known, "controller": {**known["controller"], "control.law": LAW, **best.values}}
    (pp, verdict), (ideal_pp, ideal_verdict) = figures(tuned), figures(ideal)
    found = {"pp_um": pp, "verdict": verdict, "full_pp_um": ideal_pp, "full_verdict": ideal_verdict}
    return {**found, "ratio": pp / ideal_pp}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--machines", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--evaluations", type=int, default=60)
    parser.add_argument("--checked", type=int, default=50, help="uncertain machines of each design's verification")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    rows: list[Mapping[str, Any]] = []
    for number in range(options.first, options.first + options.machines):
        values = shipped_parameters(stage=options.stage)
        machine, count = drawn(node_parameters("controller", values).stage, options.seed, number)
        values["driver"].update(machine)
        values["stage"]["encoder.y_resolution"] = count
        folder = options.output / f"machine_{number}"
        folder.mkdir(parents=True, exist_ok=True)
        answer = folder / "trial.json"
        if not answer.exists():
            write_whole(answer, json.dumps(trial(values, folder, options.evaluations, options.checked)))
        row = json.loads(answer.read_text())
        rows.append(row)
        print(f"| {number} | {count * 1e6:.2f} | {_shown(row)} |", flush=True)
    good = [row for row in rows if row.get("ratio", math.inf) <= WITHIN and row["verdict"] == "in_order"]
    stable = [row for row in rows if row.get("verdict") == "in_order"]
    print(f"{len(rows)} machines: {len(stable)} in order, {len(good)} within {WITHIN} of full knowledge")


def _shown(row: Mapping[str, Any]) -> str:
    if "failed" in row:
        return f"{row['failed']}: {row['sentence']}"
    return f"{row['pp_um']:.3f} | {row['full_pp_um']:.3f} | {row['ratio']:.2f} | {row['verdict']}"


if __name__ == "__main__":
    main(sys.argv[1:])
