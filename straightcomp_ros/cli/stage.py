"""The description of a stage: write one, check it, and show what follows from it."""

SUMMARY = "describe your own stage: write the description, check it, show what follows"
TOOLS = ("new", "check", "show")
