"""The machine as equations: actuator, friction, platform, amplifier, stage, converters. No ROS."""
