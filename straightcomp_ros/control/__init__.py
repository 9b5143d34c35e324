"""Design of the servo and its control laws. No ROS, and no NumPy in a step."""
