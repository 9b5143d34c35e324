"""Tools for the CAN bus."""

SUMMARY = "a CAN bus between processes, and recorded buses"
TOOLS = ("hub", "replay", "firmware")
