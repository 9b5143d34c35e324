"""A wheel in an empty environment: which verbs are there, and which dependencies came, without and with extras."""

import json
import shutil
import subprocess
import sys
import venv

import pytest
from places import REPOSITORY
from test_command_line import EXTRAS, OURS

pytestmark = pytest.mark.nightly

SOURCES = ("straightcomp_ros", "config", "launch", "resource", "package.xml", "setup.py", "setup.cfg", "pyproject.toml")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "source").mkdir()
    for name in (*SOURCES, "README.md", "LICENSE"):
        copy = shutil.copytree if (REPOSITORY / name).is_dir() else shutil.copy
        copy(REPOSITORY / name, folder / "source" / name)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(folder / "source")]
    subprocess.run(command, check=True, timeout=600)
    (file,) = folder.glob("*.whl")
    return file


def installed(folder, *requirements):
    """Python of a new environment in ``folder``, and how to run it without what this one says of modules elsewhere."""
    venv.create(folder, with_pip=True)
    install = [folder / "bin" / "python", "-m", "pip", "install", "-q", "--no-compile", *requirements]
    subprocess.run(install, check=True, timeout=1200, cwd=folder)
    env = {"PATH": f"{folder / 'bin'}:/usr/bin:/bin", "HOME": str(folder)}
    return folder / "bin" / "python", {"cwd": folder, "env": env}


@pytest.mark.parametrize("extras", [(), tuple(EXTRAS)], ids=["plain", "all extras"])
def test_a_wheel_has_every_verb_and_brings_what_its_extras_name_and_nothing_of_the_others(wheel, tmp_path, extras):
    python, clean = installed(tmp_path, f"{wheel}[{','.join(extras)}]" if extras else str(wheel))
    listed = json.loads(subprocess.check_output([python, "-m", "pip", "list", "--format", "json"], **clean))
    there = {one["name"].lower() for one in listed}
    assert there & set().union(*EXTRAS.values()) == set().union(*(EXTRAS[extra] for extra in extras))
    assert "rclpy" not in " ".join(there)
    for verb, entry in OURS.items():
        command = [tmp_path / "bin" / "straightcomp", verb, "--help"]
        run = subprocess.run(command, capture_output=True, text=True, timeout=300, **clean)
        # A verb may show its help without its extra; what it must not do is to fail otherwise.
        named = [f"[{extra}]" in run.stderr for extra in set(entry.extras) - set(extras)]
        assert run.returncode == 0 or (run.returncode == 2 and any(named)), (verb, run.stderr)


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="NumPy 1 has no wheel for it")
def test_with_numpy_1_as_ubuntu_has_it_a_stage_has_the_margins_that_it_has_here(wheel, tmp_path, verb):
    words = ["stage", "check", str(REPOSITORY / "config" / "stage_synthetic.yaml"), "--json"]
    _, clean = installed(tmp_path, str(wheel), "numpy<2")
    found = json.loads(subprocess.check_output([tmp_path / "bin" / "straightcomp", *words], timeout=300, **clean))
    assert "phase" in str(found) and found == verb(*words).json
