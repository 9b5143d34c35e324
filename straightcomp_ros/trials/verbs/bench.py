"""Measure this computer: the running graph, the functions that are called in each cycle, or work on many bags."""

SUMMARY = "measure the graph's timing, or the cost of its functions"
TOOLS = ("bags", "boards", "can", "graph", "history", "stages", "step", "wear")
TOOL = "BENCH"
"""Placeholder for a tool's name in the help text."""
