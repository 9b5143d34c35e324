"""Robustness: many strokes on machines that differ from the one that the controller was designed for. No ROS."""
