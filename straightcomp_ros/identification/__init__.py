"""Plant parameters from a recorded run: friction, mass, stiffness, with confidence intervals. No ROS."""


class IdentificationError(ValueError):
    """A recording cannot be identified; the text names the bag, what is wrong and what to do."""
