"""Straightness-compensation servo for linear-motor stages: model, control, map, bags and ROS 2 nodes."""
