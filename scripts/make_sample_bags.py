"""Make the sample bags in bags/: a survey, an uncompensated run, a compensated one, and one that was cut off.

From the top of the repository:

    python -m scripts.make_sample_bags

Everything is simulated, with the parameters of config/straightcomp.yaml where nothing else is said. Bags that are there
already are replaced. The messages are the same every time; what the bags say of their making (revision, date) is not.
"""

import shutil
import tempfile
from pathlib import Path
from random import Random
from statistics import NormalDist

import numpy as np

from straightcomp_ros.bags.information import ORIGIN_METADATA, origin
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.bags.topics import Topic, TopicQos
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import DISPLACEMENT, ENCODER, STROKE
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.survey import Run, Survey, write_survey

SEED = 1760
START_NS = 1_700_000_000_000_000_000
LAW = "smc_observer"
SHORT = {"motion.stroke": 0.2, "motion.settle": 0.2, "motion.pause": 0.1, "drive.delay": 0.5}
"""Part of the stroke: what a run of the whole one takes would be more than a repository should hold."""
CUT_AT = 0.6
"""Part of the file that is left of the recording that was cut off."""

SURVEY_CYCLES, SURVEY_RATE = 5, 100
NOISE, RESOLUTION = 0.03e-6, 0.01e-6
DRIFT = 0.02e-6
"""From one run to the next, as the room warms up."""
HYSTERESIS = 0.04e-6
SPIKES = 12
KNOCK = (3, 1.1, 0.05, 2e-6)
"""Run, and x, length and height in m of a stretch over which a person leant on the straight edge."""


def survey(folder: Path) -> None:
    """Five cycles over the guide at 0.3 m/s: `encoder` and the sensor, each 100 times a second."""
    guide = load_map(MapParameters(file="config/guide_synthetic.csv"))
    random, normal = Random(SEED), NormalDist()
    cycle = Trajectory(forward_and_back(MotionParameters(stroke=STROKE)))
    count = SURVEY_CYCLES * cycle.end_ns * SURVEY_RATE // 10**9
    spikes = set(random.sample(range(count), SPIKES))
    period = 10**9 // SURVEY_RATE
    run, last_x = 0, 0.0
    with BagWriter(folder) as bag:
        for stream in (ENCODER, DISPLACEMENT):
            bag.add(Topic(f"/{stream.topic}", stream.layout.type_name, TopicQos("best_effort", depth=1000)))
        bag.add_metadata(ORIGIN_METADATA, origin())
        for index in range(count):
            number, within = divmod(index * period, cycle.end_ns)
            # The sensor samples between two samples of the encoder.
            x, x_sensor = (cycle.position(time) for time in (within, within + period // 3))
            backward = x < last_x or (x == last_x and run % 2 == 1)
            run, last_x = 2 * number + backward, x
            reading = guide.deviations(x_sensor) + run * DRIFT - backward * HYSTERESIS
            reading += NOISE * normal.inv_cdf(random.random())
            reading += random.choice((-1, 1)) * 4e-6 if index in spikes else 0.0
            knocked, at, length, height = KNOCK
            reading += height if run == knocked and abs(x_sensor - at) < length / 2 else 0.0
            stamp = START_NS + index * period
            sample = (round(x, 7), 0.0, np.nan, np.nan)
            bag.write(f"/{ENCODER.topic}", ENCODER.layout.pack(stamp, *sample), stamp, stamp)
            stamp += period // 3
            quantised = round(reading / RESOLUTION) * RESOLUTION
            bag.write(f"/{DISPLACEMENT.topic}", DISPLACEMENT.layout.pack(stamp, quantised), stamp, stamp)


def simulated(folder: Path, map_file: str | None = None) -> None:
    """A short stroke forward and back at the full rate; with ``map_file`` in the place of the survey."""
    values = shipped_parameters()
    values["stage"].update(SHORT)
    values["controller"]["control.law"] = LAW
    if map_file:
        values["stage"]["guide.file"] = map_file
    simulation = Simulation(values)
    with SimulatedRun(folder, by_node(values), simulation.delay) as bag:
        simulation.run(observe=bag.add)


def flat_survey(path: Path) -> None:
    """A guide that is straight but for 0.01 µm, the least that a survey may have: the platform stays where it is."""
    x = np.linspace(0.0, STROKE, 177)
    write_survey(path, Survey((Run("1", "forward", x, np.linspace(0.0, 0.011e-6, x.size)),)), ["No correction."])


def cut_off(folder: Path, whole: Path) -> None:
    """What a power failure leaves of ``whole``."""
    folder.mkdir()
    data = (whole / f"{whole.name}_0.mcap").read_bytes()
    (folder / f"{folder.name}_0.mcap").write_bytes(data[: round(CUT_AT * len(data))])


def make(directory: Path) -> None:
    """Write all bags into ``directory``."""
    directory.mkdir(parents=True, exist_ok=True)
    for name in ("survey", "uncompensated", "smc", "cut_off"):
        shutil.rmtree(directory / name, ignore_errors=True)
    survey(directory / "survey")
    with tempfile.TemporaryDirectory() as folder:
        flat_survey(Path(folder) / "flat.csv")
        simulated(directory / "uncompensated", str(Path(folder) / "flat.csv"))
    simulated(directory / "smc")
    cut_off(directory / "cut_off", directory / "smc")


if __name__ == "__main__":
    make(Path(__file__).resolve().parent.parent / "bags")
