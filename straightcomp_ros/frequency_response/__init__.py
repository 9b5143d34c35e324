"""Frequency responses of plant and loop, measured in the closed loop and in closed form. No ROS."""


class FrequencyResponseError(ValueError):
    """No frequency response can be measured; the message names what is wrong and what would help."""


class ExcitationEnded(FrequencyResponseError):
    """The platform left the allowed travel, and the excitation faded out."""
