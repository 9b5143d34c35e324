"""Design of the servo and its control laws. No ROS, and no NumPy in a step."""


class FrequencyResponseError(ValueError):
    """No frequency response can be measured; the message names what is wrong and what would help."""
