"""What compiling costs those who do not compute."""

import pickle
import subprocess
import sys

import pytest

from straightcomp_ros.model.plant import advance


@pytest.mark.parametrize("module", ["parameters.node_parameters", "runtime.managed", "control.laws"])
def test_to_read_parameters_imports_neither_numba_nor_scipy(module):
    code = f"import sys, straightcomp_ros.{module}; print(sorted({{'numba', 'llvmlite', 'scipy'}} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert result.stdout.strip() == "[]"


def test_a_compiled_function_goes_to_another_process_by_its_name():
    assert pickle.loads(pickle.dumps(advance)) is advance
    assert advance.__name__ == "advance" and "constants" in advance.__doc__
