"""How far a machine may be from its description."""

from dataclasses import dataclass

from straightcomp_ros.parameters.declaration import RefusedParameter, parameter


@dataclass(frozen=True)
class UncertaintyParameters:
    """Ranges of a sweep. The converters and the guide stay nominal."""

    mass: float = parameter(0.2, "Mass: uniform within ± this fraction of it", "[0, 0.9]")
    force: float = parameter(
        0.2,
        "Force of the magnets at the same gap and currents (turns² times pole area, and so K̄_i and K̄_y): uniform "
        "within ± this fraction of it",
        "[0, 0.9]",
    )
    air_gap: float = parameter(0.1, "Air gap: uniform within ± this fraction of it", "[0, 0.9]")
    friction: float = parameter(
        2.0,
        "Coulomb, static and viscous friction: log-uniform between one over this factor and this factor; bristles "
        "keep their stiffness and damping",
        "[1, 100]",
    )
    amplifier: float = parameter(
        1.0, "Amplifier's bandwidth: log-uniform between one over this factor and this factor", "[1, 100]"
    )
    sensor_noise: float = parameter(
        0.5,
        "Noise on y before the encoder rounds: normal, white; its standard deviation is uniform from 0 to this",
        "[0, 1000] counts",
    )
    shortest_delay: float = parameter(
        0.2, "Command delay, constant in a trial: uniform from this, relative to drive.delay", "[0, 10]"
    )
    longest_delay: float = parameter(
        1.5, "Command delay, constant in a trial: uniform up to this, relative to drive.delay", "[0, 10]"
    )
    jitter: float = parameter(
        0.04,
        "Time from each sample's place on the grid: uniform within ± this; the stamp tells the true time",
        "[0, 0.4] samples",
    )
    map_noise: float = parameter(
        0.02e-6, "Standard deviation of an error of each point of the survey: normal", "[0, 1e-5] m"
    )

    def __post_init__(self) -> None:
        if self.longest_delay < self.shortest_delay:
            raise RefusedParameter(
                "longest_delay",
                f"{self.longest_delay!r} is below the shortest; allowed: >= {self.shortest_delay!r} "
                "('{group}shortest_delay')",
            )
