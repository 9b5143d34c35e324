"""What months of strokes say of a stage: trends, changes, their likely causes, a proposed map, a report. No ROS."""


class MaintenanceError(ValueError):
    """A stage's history, or a file of advice, does not serve; the text says why, and what is needed."""
