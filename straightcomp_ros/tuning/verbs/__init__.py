"""The verbs of tuning."""
