"""What the project itself costs: the running graph, and the parts that it calls in each cycle."""
