"""Frequency responses of plant and loop, measured in the closed loop and in closed form. No ROS."""

from straightcomp_ros.control.excitation import FrequencyResponseError


class ExcitationEnded(FrequencyResponseError):
    """The platform left the allowed travel, and the excitation faded out."""
