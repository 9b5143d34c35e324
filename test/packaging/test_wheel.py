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


@pytest.mark.parametrize("extras", [(), tuple(EXTRAS)], ids=["plain", "all extras"])
def test_a_wheel_has_every_verb_and_brings_what_its_extras_name_and_nothing_of_the_others(wheel, tmp_path, extras):
    venv.create(tmp_path, with_pip=True)
    python, named = tmp_path / "bin" / "python", f"[{','.join(extras)}]" if extras else ""
    install = [python, "-m", "pip", "install", "-q", "--no-compile", f"{wheel}{named}"]
    # Without what this environment says of modules elsewhere.
    clean = {"cwd": tmp_path, "env": {"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin", "HOME": str(tmp_path)}}
    subprocess.run(install, check=True, timeout=1200, cwd=tmp_path)
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
