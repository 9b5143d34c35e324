"""Machines that are drawn at random, each commissioned without a look at the truth; and what full knowledge gives.

    python -m scripts.blind_trials test/tuning/commissioning/rough.yaml --machines 50 --seed 1 -o DIR

All is drawn within `stage.uncertainty`, friction and amplifier log-uniformly, and the encoder's count log-uniformly
from 0.05 to 0.5 µm. With ``--kinds`` each machine has one or two resonances that no description has, and a kind of
friction; of these the description knows bearing and bristles, as a builder does, but not whether blocks slip. Full
knowledge is the same design with the same effort, from a description that is the machine.
Figures are of the true error, medians of three starts. The platform's true position is watched throughout: while it is
commissioned, in these starts, and standing still for some seconds. A row is printed as soon as it is known; a machine
that DIR has already is not repeated. Exit code 1 if the machines do not show what is asked of them.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.analysis.error_detail import sustained_oscillation, tolerated_amplitude
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.run_verdict import verdict_on
from straightcomp_ros.hardware.interface import Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import runs_of_starts, spread
from straightcomp_ros.parameters.node_parameters import Values, node_parameters
from straightcomp_ros.parameters.output_files import making, remove, write_whole
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.commissioning.closed_loop import DELAY_STAYS, STAYS_OPEN
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine
from straightcomp_ros.tuning.commissioning.procedure import Procedure
from straightcomp_ros.tuning.design.automatic_design import design_gains
from straightcomp_ros.tuning.design.feasible_gains import DesignError
from trials.faulty_machine import FaultyHardware

STARTS = 3
MODES, DAMPINGS, SEEN = (60.0, 600.0), (0.005, 0.03), (0.02, 0.3)
"""Of the drawn resonances: Hz, damping ratio, and the size of φ_c φ_e."""
FRICTIONS = ("lugre", "none", "unvarying", "blocks", "stiction")
BRISTLES, STATIC = (1e7, 1e9), (1.0, 2.0)
"""Of drawn stiction: stiffness in N/m, and static over Coulomb friction."""
COUNTS = (0.05e-6, 0.5e-6)
LAW = "smc_observer"
WITHIN, ENOUGH = 1.25, 0.94
WITHIN_OF_KINDS, ENOUGH_OF_KINDS = 1.3, 0.9
"""Ratio to full knowledge, and the share of machines that must keep it."""
STROKES = 3
REST = 4.0
"""s at rest under the law that was left."""


class Watched(FaultyHardware):
    """A sound machine of which the farthest true position is kept in ``farthest``, m."""

    farthest = 0.0

    def read(self, now_ns: int) -> Sequence[tuple[Sample, Truth | None]]:
        found = super().read(now_ns)
        self.farthest = max([self.farthest, *(abs(truth.y) for _, truth in found if truth is not None)])
        return found


class WatchedMachine(SimulatedMachine):
    """A machine that counts its strokes, and how far its platform was from the middle."""

    def __init__(self, values: Values) -> None:
        self._watched: list[Watched] = []
        self.strokes = 0
        super().__init__(values, self._watch)

    def _watch(self, hardware: SimulatedHardware) -> Watched:
        self._watched.append(Watched(hardware))
        return self._watched[-1]

    def stroke(self, values: Values, bag: Path, travel: float, count: int = 1) -> None:
        self.strokes += count
        super().stroke(values, bag, travel, count)

    @property
    def farthest(self) -> float:
        """Largest true |y| so far, m."""
        return max((one.farthest for one in self._watched), default=0.0)


def drawn(stage: StageParameters, seed: int, number: int) -> tuple[dict[str, float], float]:
    """Values of the driver for machine ``number``, and its encoder's count in m."""
    ranges, u = stage.uncertainty, np.random.default_rng([seed, number]).random(7).tolist()
    factors = ranges.factors(*(2.0 * one - 1.0 for one in u[:5]))._asdict()
    late = ranges.shortest_delay + (ranges.longest_delay - ranges.shortest_delay) * u[5]
    machine = {f"simulated.truth.{name}": value for name, value in factors.items() if name != "modes"}
    count = COUNTS[0] * (COUNTS[1] / COUNTS[0]) ** u[6]
    return {**machine, "stage.drive.delay": late * stage.drive.delay}, count


def kind(stage: StageParameters, seed: int, number: int) -> Values:
    """Resonances and friction of machine ``number``: parameters of the nodes driver and stage, in which they differ."""
    random = np.random.default_rng([seed, number, 1])

    def drawn_log(ends: tuple[float, float]) -> float:
        return math.exp(random.uniform(*np.log(ends)))

    truth, described = dict[str, Any](), dict[str, Any]()
    for name in ("first", "second")[: int(random.integers(1, 3))]:
        seen, apart = drawn_log(SEEN), random.uniform() < 0.5
        mode = {"frequency": drawn_log(MODES), "damping": drawn_log(DAMPINGS), "coil": math.sqrt(seen)}
        mode["encoder"] = -mode["coil"] if apart else mode["coil"]
        truth |= {f"simulated.truth.modes.{name}.{fact}": value for fact, value in mode.items()}
    match FRICTIONS[int(random.integers(len(FRICTIONS)))]:
        case "none":
            described |= {"friction.coulomb": 0.0, "friction.static": 0.0}
        case "unvarying":
            described["friction.static"] = stage.friction.coulomb
        case "blocks":
            truth["simulated.truth.contact.model"] = "maxwell_slip"
        case "stiction":
            described["friction.bristle_stiffness"] = drawn_log(BRISTLES)
            described["friction.static"] = stage.friction.coulomb * random.uniform(*STATIC)
    return {"driver": truth, "stage": described}


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
        **{f"uncertainty.{name}": least for name, least in STAYS_OPEN.items()},
        "uncertainty.shortest_delay": 1.0 - DELAY_STAYS,
        "uncertainty.longest_delay": 1.0 + DELAY_STAYS,
    }
    for name in ("first", "second"):
        truth = {k.removeprefix("simulated.truth."): v for k, v in values["driver"].items() if f".modes.{name}." in k}
        known = {"frequency_error": 0.01, "damping_factor": 1.2, "participation_error": 0.1} if truth else {}
        facts |= {f"platform.{k}": v for k, v in truth.items()}
        facts |= {f"platform.modes.{name}.{k}": v for k, v in known.items()}
    own = {
        name: v
        for name, v in values["driver"].items()
        if "contact" in name or not name.startswith(("simulated.truth.", "stage."))
    }
    described = {node: dict(section) for node, section in values.items()}
    return {**described, "stage": {**described["stage"], **facts}, "driver": own}


def figures(values: Values) -> tuple[float, str, float]:
    """Median true peak-to-peak error in µm over the starts, the worst verdict, and the largest true |y| in m."""
    found, verdicts, farthest = [], [], 0.0
    for record, straightness in runs_of_starts(values, STARTS):
        found.append((evaluate(record, straightness).true_pp or math.nan) * 1e6)
        verdicts.append(verdict_on(record, straightness, values).verdict)
        farthest = max(farthest, float(np.abs(record.true_y).max()))
    verdict = next((one for one in verdicts if one != "in_order"), "in_order")
    return spread(found).median, verdict, farthest


def at_rest(values: Values) -> tuple[float, bool]:
    """True motion p-p in µm while the stage stands still, and whether it is an oscillation."""
    motion = node_parameters("cell", values).stage.motion
    place = motion.start + 0.5 * motion.stroke
    simulation = Simulation(
        values, motion=(Trajectory([Waypoint(0, place, 0.0), Waypoint(int(REST * 1e9), place, 0.0)]), 0)
    )
    record = simulation.run()
    assert record.true_y is not None
    # In the first second the law settles.
    settled = record.time > 1.0
    moved, reference = record.true_y[settled], record.r[settled]
    stage = node_parameters("controller", values).stage
    swing = sustained_oscillation(moved - moved.mean(), reference, stage.period)
    allowed = tolerated_amplitude(moved, stage.encoder.y_resolution, 0.0)
    return float(np.ptp(moved)) * 1e6, swing.amplitude > allowed


def trial(values: Values, folder: Path, evaluations: int, machines: int) -> dict[str, Any]:
    """Commission one machine, and design it with full knowledge."""
    machine = WatchedMachine(values)
    procedure = Procedure(machine, values, folder, evaluations=evaluations, machines=machines)
    stop = node_parameters("driver", values).plant.platform.stop
    for step in procedure.steps():
        outcome = procedure.run(step)
        if not outcome.passed:
            return {
                "failed": step,
                "sentence": outcome.sentence,
                "strokes": machine.strokes,
                "farthest_share_of_stop": machine.farthest / stop,
            }
    work = procedure.work("certificate")
    tuned = {**work.values, "driver": machine.parameters}
    pp, verdict, farthest = figures(tuned)
    rest_pp, swings = at_rest(tuned)
    found = {
        "pp_um": pp,
        "verdict": "oscillates at rest" if verdict == "in_order" and swings else verdict,
        "rest_pp_um": rest_pp,
        "strokes": machine.strokes,
        "farthest_share_of_stop": max(farthest, machine.farthest) / stop,
    }
    known = with_full_knowledge(values)
    try:
        best = design_gains(make_scenario(known, [LAW]), LAW, evaluations=evaluations, machines=machines, jobs=1)
    except DesignError as error:
        return {**found, "failed": "full knowledge", "sentence": str(error)}
    ideal_pp, ideal_verdict, _ = figures(
        {**known, "controller": {**known["controller"], "control.law": LAW, **best.values}}
    )
    return {**found, "full_pp_um": ideal_pp, "full_verdict": ideal_verdict, "ratio": pp / ideal_pp}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--machines", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--evaluations", type=int, default=60)
    parser.add_argument("--checked", type=int, default=50, help="uncertain machines of each design's verification")
    parser.add_argument("--kinds", action="store_true", help="machines with resonances, of all kinds of friction")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    rows: list[Mapping[str, Any]] = []
    for number in range(options.first, options.first + options.machines):
        values = shipped_parameters(stage=options.stage)
        stage = node_parameters("controller", values).stage
        machine, count = drawn(stage, options.seed, number)
        values["driver"].update(machine)
        values["stage"]["encoder.y_resolution"] = count
        if options.kinds:
            for node, facts in kind(stage, options.seed, number).items():
                values[node].update(facts)
        folder = options.output / f"machine_{number}"
        answer = folder / "trial.json"
        if not answer.exists():
            # From its beginning: strokes of an interrupted trial would not be counted.
            with making(options.output, [folder.name], anew=False):
                remove(folder)
                folder.mkdir()
                row = {"machine": number, "count_um": count * 1e6}
                row |= trial(values, folder, options.evaluations, options.checked)
                write_whole(answer, json.dumps(row))
        rows.append(json.loads(answer.read_text()))
        print(f"| {number} | {count * 1e6:.2f} | {_shown(rows[-1])} |", flush=True)
    kept = (WITHIN_OF_KINDS, ENOUGH_OF_KINDS) if options.kinds else (WITHIN, ENOUGH)
    sys.exit(0 if _holds(rows, *kept) else 1)


def _shown(row: Mapping[str, Any]) -> str:
    watched = f"{row['strokes']} | {row['farthest_share_of_stop']:.2f}"
    if "failed" in row:
        return f"{row['failed']}: {row['sentence']} | {watched}"
    return (
        f"{row['pp_um']:.3f} | {row['full_pp_um']:.3f} | {row['ratio']:.2f} | {row['verdict']} | "
        f"{row['rest_pp_um']:.3f} | {watched}"
    )


def _holds(rows: Sequence[Mapping[str, Any]], within: float, enough: float) -> bool:
    """Print what the machines show, and say whether it is what is asked."""
    stable = [row for row in rows if row.get("verdict") == "in_order"]
    good = [row for row in stable if row.get("ratio", math.inf) <= within]
    strokes = max(row["strokes"] for row in rows)
    nearest = max(row["farthest_share_of_stop"] for row in rows)
    print(
        f"{len(rows)} machines: {len(stable)} in order, {len(good)} within {within} of full knowledge; at most "
        f"{strokes} strokes each; the platform came no nearer to its stop than {nearest:.0%} of the way"
    )
    ratios = sorted(row["ratio"] for row in stable if "ratio" in row)
    if ratios:
        least, median, high, most = np.quantile(ratios, (0.0, 0.5, 0.9, 1.0)).tolist()
        print(f"ratio: {least:.2f} least, {median:.2f} median, {high:.2f} at 90 %, {most:.2f} most")
    return len(stable) == len(rows) and len(good) >= enough * len(rows) and strokes <= STROKES and nearest < 1.0


if __name__ == "__main__":
    main(sys.argv[1:])
