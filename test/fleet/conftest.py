"""Bags of several stages for a history, and stores of them; months of a stage, by hand or from simulated strokes."""

import shutil

import numpy as np
import pytest
from generated_bags import write_bag
from places import BAGS, SMC
from stores import COUNT, STAGES, added, files_of

from straightcomp_ros.fleet.maintenance.day_levels import FIGURES, DayLevels
from trials.wear import Pool, stroke_pool, write_store

DAYS, BINS = 120, 100
LEVELS = {"friction_A": 0.007, "stiffness_A_per_m": 667.0, "amplifier_bandwidth_Hz": 500.0, "latency_p50_us": 120.0}
TWENTY_THOUSAND = 20_454
"""2026-01-01."""


@pytest.fixture(scope="session")
def months(tmp_path_factory):
    """A folder with COUNT good bags of STAGES stages, one that was cut off, and one with damage in its middle."""
    folder = tmp_path_factory.mktemp("months")
    for number in range(COUNT):
        write_bag(folder / f"stage_{number % STAGES}" / f"run_{number}", number, STAGES)
    shutil.copytree(BAGS / "cut_off", folder / "cut_off")
    damaged = folder / "damaged"
    shutil.copytree(SMC, damaged)
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


@pytest.fixture
def make_levels():
    """``make(friction_A=(n,) factors, guide=(n, m) µm, software=…)``: months that scatter by half a percent."""

    def make(guide=None, software=None, **factors):
        random = np.random.default_rng(3)
        columns = {}
        for name in FIGURES:
            level = 0.0 if name == "lost_samples" else LEVELS.get(name, 1.0)
            columns[name] = level * (1.0 + 0.005 * random.standard_normal(DAYS)) * factors.pop(name, np.ones(DAYS))
        assert not factors
        noise = 0.005 * random.standard_normal((DAYS, BINS))
        profile = np.full((DAYS, BINS), np.nan) if guide is None else guide + noise
        return DayLevels(
            day=TWENTY_THOUSAND + np.arange(DAYS),
            columns=columns,
            x=(np.arange(BINS) + 0.5) * 0.01,
            profiles={"guide_change_um": profile, "error_bins_um": noise},
            settings={"software": software or ["1.1"] * DAYS, "map": ["a"] * DAYS, "parameters": ["b"] * DAYS},
        )

    return make


@pytest.fixture(scope="session")
def pool() -> Pool:
    return stroke_pool(1)


@pytest.fixture(scope="session")
def worn(pool, tmp_path_factory):
    """A store with some months of a stage of each wear."""
    folder = tmp_path_factory.mktemp("worn")
    write_store(folder, pool, days=160, begin=60)
    return folder
