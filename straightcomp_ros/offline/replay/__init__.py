"""Runs a recorded run again: to the bit, or with other laws and parameters."""
