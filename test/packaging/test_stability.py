"""What docs/stability.md promises is there, and what must never be given to something else is not."""

import importlib
import inspect
import re

import pytest
from places import page

from straightcomp_ros.cli.main import make_parser
from straightcomp_ros.safety.faults import Fault

PAGE, API = page("stability"), page("api")
FAULTS = """
command_not_finite command_out_of_range command_timeout two_controllers sample_not_finite x_jump y_out_of_range y_frozen
x_frozen clock_jump map_missing sample_timeout heartbeat_lost board tripped recording_stopped following_error
client_gone not_referenced
"""
"""Every fault that ever was in a release, in the order of their numbers, from 1: add to it, and take nothing away."""


def test_no_fault_has_another_number_than_before():
    numbers = {fault.label: fault.code for fault in Fault}
    assert numbers.items() <= {label: number for number, label in enumerate(FAULTS.split(), 1)}.items()


@pytest.mark.parametrize("name", re.findall(r"^::: ([\w.]+)", API, re.MULTILINE))
def test_a_public_module_is_there_and_says_what_its_public_names_are(name):
    module = importlib.import_module(name)
    ours = [one for one in vars(module).values() if getattr(one, "__module__", "") == name and callable(one)]
    assert ours and all(inspect.getdoc(one) for one in ours if not one.__name__.startswith("_"))


def test_the_namespace_the_exceptions_among_the_verbs_and_the_oldest_python_are_those_of_the_code(setup_arguments):
    assert f"| Python | {setup_arguments['python_requires'].removeprefix('>=')} to " in PAGE
    opcua = pytest.importorskip("straightcomp_ros.opcua")
    assert f"namespace `{opcua.NAMESPACE}`" in PAGE
    excepted = re.search(r"except those of (.*?) \|", PAGE)
    for verb in re.findall(r"`(\w+)`", excepted[1]):
        with pytest.raises(SystemExit, match="0"):
            make_parser().parse_args([verb, "--help"])
