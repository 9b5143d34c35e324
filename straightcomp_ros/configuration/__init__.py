"""All parameters of all nodes, and the file that sets them. No ROS."""
