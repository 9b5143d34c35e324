"""Automatic design: the gains of a law from the description of a stage. No ROS."""
