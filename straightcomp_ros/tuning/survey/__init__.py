"""From a recorded survey, or a file of an instrument or a machine controller, to a survey file. No ROS."""
