"""Builds the ament_python package: for colcon, and for pip in a plain virtual environment."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "straightcomp_ros"
MANIFEST = ElementTree.parse("package.xml").getroot()
"""Version and texts are written in package.xml and nowhere else."""
OPCUA = ["asyncua>=2.1,<2.2", "cryptography"]
TUNING = ["cma>=4"]
# pyarrow 26 needs NumPy 2; a sourced Jazzy brings Ubuntu 24.04's 1.26.
FLEET = ["duckdb>=1.1", "fsspec>=2022.11", "pyarrow>=17,<26"]
DOCS = ["mkdocs>=1.6", "mkdocs-material>=9.5", "mkdocstrings[python]", "latex2mathml"]


NODES = "driver feedforward controller servo logger cell player opcua commissioning"
SERVO_VERBS = "bench can completion demo doctor dsp evaluate incident recover replay simulate stage view"
TUNING_VERBS = "commission design frequency-response friction reproduce robustness"


def _verbs(folder, names, extra=""):
    """Entry points of verbs: the module of each, and the extra that brings what it needs."""
    return [f"{name} = {NAME}.{folder}.{name.replace('-', '_')} {extra}".rstrip() for name in names.split()]


def _installed_files(folder):
    """(destination, files) for ``folder`` and all below it, as setuptools' data_files wants them."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            found.setdefault(f"share/{NAME}/{path.parent.as_posix()}", []).append(path.as_posix())
    return sorted(found.items())


setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description=MANIFEST.findtext("description"),
    license=MANIFEST.findtext("license"),
    maintainer=MANIFEST.findtext("maintainer"),
    maintainer_email=MANIFEST.find("maintainer").get("email"),
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={"": ["*.html", "*.css", "*.jinja"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *_installed_files("config"),
        *_installed_files("launch"),
    ],
    zip_safe=False,
    python_requires=">=3.10",
    install_requires=[
        "cantools>=39",
        "fastcrc>=0.3.4",
        "jinja2>=3.1",
        "markupsafe",
        "joblib>=1.4",
        "lz4>=4",
        "matplotlib>=3.6",
        "mcap>=1.2",
        "numba>=0.56.4",
        "numpy>=1.22",
        "plotly>=6",
        "python-can>=4.3",
        "pyyaml>=6",
        "rich>=12.3",
        "rosbags>=0.11",
        "scipy>=1.8",
        "shtab>=1.9",
        "zstandard>=0.16",
    ],
    extras_require={
        # ROS 2 Jazzy itself, where none is installed.
        "ros": [
            "ros-jazzy-rclpy[fastrtps]",
            "ros-jazzy-diagnostic-msgs",
            "ros-jazzy-lifecycle-msgs",
            "ros-jazzy-sensor-msgs",
            "ros-jazzy-std-srvs",
            "ros-jazzy-trajectory-msgs",
        ],
        # The node opcua. asyncua is LGPL-3: it is used as a library, unchanged, and only where this extra is asked for.
        # The guard of sessions (opcua/guard.py) overrides its internals: a newer one needs a look first.
        "opcua": OPCUA,
        # Sweeps and histories on other machines' cores.
        "dask": ["dask[distributed]"],
        # Gains, margins, friction and commissioning of a stage.
        "tuning": TUNING,
        # Figures of many bags in one store of Parquet files; for bags in S3 also s3fs.
        "fleet": FLEET,
        # The pages in docs/ as HTML: make docs.
        "docs": DOCS,
        # What make test needs.
        "test": [
            "pytest",
            # Live graphs on shared machines: see test/repeats.py.
            "pytest-rerunfailures>=16.3",
            "hypothesis",
            # The tests without live nodes, one process a core.
            "pytest-xdist",
            *OPCUA,
            *TUNING,
            *FLEET,
            # Another implementation of the CRCs; cantools brings it too.
            "crccheck",
            # What ROS says of package.xml.
            "catkin_pkg",
            "mypy",
            # The peer of benchmarks/peer_opensmc.py; MIT, needs numpy only.
            "opensmc>=2.0,<3",
            "psutil",
            "ruff",
            # colcon, and a test, run setup.py with the environment's own setuptools; virtual environments of Python
            # 3.12 and later have none, and 80 dropped what colcon's builds call.
            "setuptools>=65.5,<80",
        ],
        # What make nightly needs besides.
        "nightly": [
            *DOCS,
            "coverage>=7.10",
            "pytest-cov",
            # Changes of the source that tests must notice: make mutants.
            "cosmic-ray>=8.4",
            "dask[distributed]",
            # Other readers of the history's files; a server that speaks S3, and the client.
            "pandas",
            "polars",
            "s3fs",
            "moto[s3]",
            "flask",
            "flask-cors",
            "colcon-common-extensions",
            "colcon-ros",
        ],
    },
    entry_points={
        "console_scripts": [
            *(f"{node}_node = {NAME}.nodes.start:{node}_node" for node in NODES.split()),
            f"dsp_emulator = {NAME}.cli.dsp:main",
            f"straightcomp = {NAME}.cli.main:main",
        ],
        # Another package adds a verb by an entry point of the same group: docs/stability.md.
        "straightcomp.verbs": [
            *_verbs("cli", SERVO_VERBS),
            *_verbs("cli", "opcua", "[opcua]"),
            *_verbs("tuning.verbs", "map"),
            *_verbs("tuning.verbs", TUNING_VERBS, "[tuning]"),
            *_verbs("fleet.verbs", "history", "[fleet]"),
        ],
        "can.interface": [f"straightcomp_hub = {NAME}.hardware.can.hub_bus:HubBus"],
    },
)
