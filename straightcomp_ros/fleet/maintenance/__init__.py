"""What months of strokes say of a stage: trends, changes, their likely causes, a proposed map, a report. No ROS."""
