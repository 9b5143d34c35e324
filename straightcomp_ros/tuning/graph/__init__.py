"""The client of a running graph that tunes a machine."""
