"""The live view: a page on this machine with plots of the running graph. No ROS in here."""
