"""By how many samples the measured current of a bag is older than the encoders' readings beside it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.bags.recorded_parameters import recorded_parameters
from straightcomp_ros.parameters.declaration import belongs_to_ros
from straightcomp_ros.parameters.node_parameters import node_parameters


def readback_lag(bag: Path) -> int:
    """Samples; 0 where the bag does not tell.

    Raises:
        BagError: the bag cannot be read.
        ParameterError: its parameters, or the DBC file that they name, cannot be used here.
    """
    driver = recorded_parameters(bag, read_attachments(bag)).get("driver", {})
    if driver.get("hardware") != "can":
        return 0
    own = {name: value for name, value in driver.items() if not belongs_to_ros(name)}
    lag: int = node_parameters("driver", {"driver": own}).readback_lag
    return lag


def advanced(current: NDArray[np.float64], lag: int) -> NDArray[np.float64]:
    """``current`` (n,) moved to the samples at which it was measured; the last ones are not known yet: NaN."""
    return np.concatenate([current[lag:], np.full(lag, np.nan)]) if lag else current
