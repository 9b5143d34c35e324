"""Looks at the machine: what a run would miss here, and what helps. No ROS."""
