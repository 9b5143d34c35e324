"""Does once what the first run would otherwise do while its loops already run: `make setup` calls it.

Machine code of the control laws and of the plant, bytecode of the package, the list of fonts. Nodes that are started
without it do the same before they say that they are ready.
"""

import compileall
from pathlib import Path

# The import makes matplotlib's list of fonts.
from matplotlib import font_manager  # noqa: F401

import straightcomp_ros
from straightcomp_ros.control.laws import prepare_all
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import load_map


def main() -> None:
    """Fill the caches of this user and this environment."""
    compileall.compile_dir(str(Path(straightcomp_ros.__file__).parent), quiet=1)
    prepare_all()
    SimulatedHardware(SimulatedParameters(), StageParameters(), load_map())


if __name__ == "__main__":
    main()
