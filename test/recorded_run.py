"""Simulated runs recorded as bags."""

from straightcomp_ros.bags.simulated_run import START_NS, SimulatedRun
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.contract import DISPLACEMENT
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node

TOPIC = f"/{DISPLACEMENT.topic}"


def recorded_run(bag, values, see=SimulatedRun.add, sensor=None, layout=DISPLACEMENT.layout, **simulation):
    """Simulate, write the folder ``bag`` and return it; what was learned is saved where ``values`` name a file for it.

    ``see(run, sample, truth, …)`` writes a sample; ``sensor(sample, truth)`` is the reading of a displacement sensor
    in m, or None, sent by ``layout``; ``simulation`` are further arguments of `Simulation`."""
    made = Simulation(values, **simulation)
    with SimulatedRun(bag, by_node(values), made.delay) as run:
        if sensor is not None:
            run._bag.add(Topic(TOPIC, layout.type_name))

        def observe(sample, truth, *answer):
            see(run, sample, truth, *answer)
            if sensor is not None and (reading := sensor(sample, truth)) is not None:
                stamp = START_NS + sample.stamp_ns
                run._bag.write(TOPIC, layout.pack(stamp, reading), stamp, stamp)

        made.run(observe=observe)
    made.save_learning()
    return bag


def rewired(change):
    """A ``wiring`` of `Simulation`: each sample is changed, or lost where ``change`` gives None."""

    def wiring(hardware):
        read = hardware.read

        def changed(now_ns):
            samples = [(change(sample), truth) for sample, truth in read(now_ns)]
            return [(sample, truth) for sample, truth in samples if sample is not None]

        hardware.read = changed
        return hardware

    return wiring
