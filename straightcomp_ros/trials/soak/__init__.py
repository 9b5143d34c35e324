"""Runs the graph for a long time while random things are done to it."""
