"""Measure this computer: the running graph, or the functions that are called in each cycle."""

SUMMARY = "measure the graph's timing, or the cost of its functions"
TOOLS = ("graph", "step")
TOOL = "BENCH"
"""Placeholder for a tool's name in the help text."""
