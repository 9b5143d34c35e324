"""Measure this machine: the running graph, or the parts of it that are called in each cycle."""

SUMMARY = "measure the graph's timing, or what its parts cost"
TOOLS = ("bags", "can", "graph", "step")
TOOL = "BENCH"
"""What the help calls one of them."""
