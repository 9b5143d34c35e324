"""OPC UA gateway: address space, server and a reference client. No ROS in here; needs asyncua."""

NAMESPACE = "urn:straightcomp_ros:cell"
"""Namespace of all nodes of ours; index 2 on the server."""
APPLICATION = "urn:straightcomp_ros:gateway"
"""The server's application URI, which its certificate names too."""
CELL = "StraightnessCell"
"""Browse name of the object below Objects that holds everything."""
