"""When the amplifier may be on, what switches it off, and what must happen before it may be on again. No ROS."""
