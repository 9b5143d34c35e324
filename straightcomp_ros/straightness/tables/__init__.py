"""Files of instruments and machine controllers with the straightness error of an axis, or its correction. No ROS."""
