"""What a recorded stroke says of the machine: figures and pictures. No ROS."""


class IdentificationError(ValueError):
    """A recording cannot be identified; the text names the bag, what is wrong and what to do."""
