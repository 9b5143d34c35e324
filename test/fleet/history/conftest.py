"""Bags of several stages for a history, and stores of them."""

import shutil

import pytest
from stores import COUNT, SAMPLES, STAGES, added, files_of

from trials.generated_bags import template_of, write_bag


@pytest.fixture(scope="session")
def months(tmp_path_factory):
    """A folder with COUNT good bags of STAGES stages, one that was cut off, and one with damage in its middle."""
    folder = tmp_path_factory.mktemp("months")
    template = template_of(SAMPLES / "smc")
    for number in range(COUNT):
        write_bag(template, folder / f"stage_{number % STAGES}" / f"run_{number}", number, STAGES)
    shutil.copytree(SAMPLES / "cut_off", folder / "cut_off")
    damaged = folder / "damaged"
    shutil.copytree(SAMPLES / "smc", damaged)
    with (damaged / "smc_0.mcap").open("r+b") as file:
        file.seek(1_000_000)
        file.write(bytes(1000))
    return folder


@pytest.fixture(scope="session")
def alone(months, tmp_path_factory):
    """The store that one process makes of ``months``, and its files."""
    store = tmp_path_factory.mktemp("alone") / "store"
    added(store, months)
    return store, files_of(store)
