"""Tests the machine: faults, long runs, benches. No node imports it."""
