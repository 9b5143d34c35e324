"""Straightness-compensation servo for linear-motor stages: model, control, map, bags and ROS 2 nodes.

OpenBLAS's threads wait for each other in busy loops. With real-time priority on the CPU of a control loop they would
wait for ever, and the last bits of a map that is smoothed depend on how many there are: nodes, offline runs and replays
compute in one thread. The variable must be set before NumPy is imported.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
