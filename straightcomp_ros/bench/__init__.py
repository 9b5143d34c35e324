"""Measures this package on the machine that it runs on."""
