"""Does once what the first run would otherwise do while its loops already run: `make setup` calls it.

Machine code of the control laws and of the plant, bytecode of the package and of what it imports, the list of fonts.
Nodes that are started without it do the same before they say that they are ready.
"""

import compileall
import contextlib
import importlib
import pkgutil
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# Before the processes are forked, so that they do not each make its bytecode.
import numba  # noqa: F401

import straightcomp_ros
from straightcomp_ros.control.laws import prepare_all
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import load_map


def prepare_plant() -> None:
    """Compile the simulated machine."""
    SimulatedHardware(SimulatedParameters(), StageParameters(), load_map())


def main() -> None:
    """Fill the caches of this user and this environment."""
    with ProcessPoolExecutor(2) as processes:
        done = [processes.submit(prepare) for prepare in (prepare_plant, prepare_all)]
        compileall.compile_dir(str(Path(straightcomp_ros.__file__).parent), quiet=1)
        # An import writes bytecode; that of matplotlib makes its list of fonts too.
        modules = pkgutil.walk_packages(straightcomp_ros.__path__, "straightcomp_ros.", onerror=lambda name: None)
        for module in ("matplotlib.font_manager", *(one.name for one in modules)):
            # What only an extra, or ROS, brings is not there everywhere.
            with contextlib.suppress(ImportError):
                importlib.import_module(module)
        for one in done:
            one.result()


if __name__ == "__main__":
    main()
