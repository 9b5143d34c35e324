"""Plant parameters from a recorded run: friction, mass, stiffness, with confidence intervals. No ROS."""
