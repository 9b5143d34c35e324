"""Bags: rosbag2 folders with MCAP files, written and read without ROS."""


class BagError(ValueError):
    """A bag cannot be written or read; the text names the file, what is wrong and what to do."""

    damage = ""
    """What is damaged, without the file and the advice."""


class NoBag(BagError):
    """What is named as a bag is none: there is no such file or folder, or it is something else."""


PARAMETERS_ATTACHMENT = "parameters.yaml"
"""Name of a bag's attachment with the parameters of the recorded nodes, as a ROS 2 parameter file."""
MAP_ATTACHMENT = "map.csv"
"""Name of a bag's attachment with the survey that the reference was made from."""
BAND_ATTACHMENT = "map_band.csv"
"""Name of a bag's attachment with the map itself and the standard deviation that the survey's noise leaves in it."""
