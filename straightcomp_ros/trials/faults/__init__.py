"""Makes each fault in the running graph, and measures how soon it is latched."""
