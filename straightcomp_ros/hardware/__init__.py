"""One interface to the machine, and its backends. No ROS."""
