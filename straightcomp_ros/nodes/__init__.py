"""The ROS 2 nodes: thin shells around the packages that know no ROS.

OpenBLAS's threads wait for each other in a busy loop. With real-time priority on the CPU of a control loop they would wait
for ever, so that a node computes in one thread. The variable must be set before NumPy is imported.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
