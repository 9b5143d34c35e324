"""From the survey of a guide to the reference of the platform, and back to the straightness that is left. No ROS."""
