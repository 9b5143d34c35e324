"""One rule of rounding: the C core's functions are Python's round(), as are frames and converter of the emulator."""

import ctypes
import subprocess
from fractions import Fraction

import pytest
from firmware_programs import FIRMWARE
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model.converters import nearest_step


class Scale(ctypes.Structure):
    """``struct scale`` of firmware/core/scale.h."""

    _fields_ = (("numerator", ctypes.c_int32), ("denominator", ctypes.c_int32))


@pytest.fixture(scope="module", params=["double", "float"])
def core(request, firmware, tmp_path_factory):
    """The rounding of the firmware core, with its type of real numbers."""
    file = tmp_path_factory.mktemp("core") / f"scale_{request.param}.so"
    source = FIRMWARE / "core" / "scale.c"
    options = ["-std=c99", "-O2", "-shared", "-fPIC", f"-DBOARD_REAL={request.param}"]
    subprocess.run(["cc", *options, str(source), "-o", str(file)], check=True, timeout=60)
    library = ctypes.CDLL(str(file))
    real = ctypes.c_double if request.param == "double" else ctypes.c_float
    library.nearest.argtypes, library.nearest.restype = [real], ctypes.c_int32
    library.nearest_of_many.argtypes, library.nearest_of_many.restype = [real], ctypes.c_int64
    library.scaled.argtypes, library.scaled.restype = [Scale, ctypes.c_int32], ctypes.c_int64
    library.real = lambda value: real(value).value
    return library


TIES = st.integers(-(2**20), 2**20).map(lambda whole: whole + 0.5)
SMALL = st.floats(-(2.0**30), 2.0**30) | TIES | st.just(0.49999999999999994)
LARGE = st.floats(-(2.0**62), 2.0**62) | st.integers(-(2**53), 2**53).map(float) | TIES.map(lambda one: one * 2**31)


@given(value=SMALL | LARGE)
def test_a_real_number_is_rounded_as_python_does(core, value):
    value = core.real(value)
    assert core.nearest_of_many(value) == nearest_step(1.0, 2**63, value) == round(value)
    assert abs(value) >= 2.0**30 or core.nearest(value) == round(value)


@given(
    counts=st.integers(-(2**31), 2**31 - 1),
    numerator=st.integers(-(2**31), 2**31 - 1),
    denominator=st.integers(1, 2**31 - 1) | st.sampled_from([2, 4, 20]),
)
def test_counts_are_scaled_by_a_fraction_as_python_rounds_it(core, counts, numerator, denominator):
    assert core.scaled(Scale(numerator, denominator), counts) == round(Fraction(counts * numerator, denominator))
