"""The ROS 2 nodes: thin shells around the packages that know no ROS."""
