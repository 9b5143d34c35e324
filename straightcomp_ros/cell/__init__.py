"""Around the loop: starts the graph, runs cycles of the stage, and judges what was seen of them. No ROS."""
