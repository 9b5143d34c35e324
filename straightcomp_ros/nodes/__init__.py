"""The ROS 2 nodes: thin shells around the packages that know no ROS.

OpenBLAS's threads wait for each other in busy loops. With real-time priority on the CPU of a control loop they would
wait for ever, so a node computes in one thread. The variable must be set before NumPy is imported.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
