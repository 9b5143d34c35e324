"""Frequency responses of plant and loop, measured in the closed loop and in closed form. No ROS."""
