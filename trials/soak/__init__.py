"""Runs the graph for a long time with random actions on it."""
