"""Runs without a graph: simulation, comparison of laws, replay, sweeps. No ROS."""
