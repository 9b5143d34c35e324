"""Tools for the CAN bus."""

SUMMARY = "a CAN bus between processes, recorded buses, and frames in C"
TOOLS = ("hub", "replay", "firmware")
