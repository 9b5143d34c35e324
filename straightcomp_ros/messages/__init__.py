"""The bytes of a message: fixed-layout CDR, and batches of samples. No ROS."""
