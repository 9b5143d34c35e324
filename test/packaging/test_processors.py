"""What the script sets that runs tests as on other processors."""

import platform
import subprocess
import sys

import pytest

from scripts import processors


@pytest.mark.skipif(platform.machine() != "x86_64", reason="NOT TESTED: other processors are simulated on x86-64 only")
def test_numpy_knows_every_instruction_that_it_is_to_do_without():
    # Of a name that it does not know NumPy only warns, and uses its newest instructions.
    program = (
        "import numpy as np; umath = getattr(np, '_core', None) or np.core; umath = umath._multiarray_umath\n"
        "print([name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]])"
    )
    command = [sys.executable, "-W", "error", "-c", program]
    environment = processors.environment("PRESCOTT")
    printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=120).stdout
    assert printed.strip() == "[]"
