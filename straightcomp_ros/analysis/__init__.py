"""What a recorded stroke says of the machine: figures and pictures. No ROS."""
