"""Benches of development: what bags, boards, buses, histories and stages cost."""

SUMMARY = "measure what bags, boards, the bus, histories and several stages cost"
TOOL = "BENCH"
TOOLS = ("bags", "boards", "can", "history", "stages", "wear")
