"""Injects each fault into the running graph, and measures how soon it is latched."""
