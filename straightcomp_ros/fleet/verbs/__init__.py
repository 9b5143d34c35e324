"""The verbs of a fleet."""
