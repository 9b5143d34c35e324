"""Parameters: declared once, found with what the package installs. No ROS."""
