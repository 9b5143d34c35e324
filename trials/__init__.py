"""Test rigs and benches of development. Not installed, and nothing of the package imports them."""
