"""The pages: made from the code where they repeat it, and without a broken link."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted([*(REPOSITORY / "docs").glob("*.md"), *REPOSITORY.glob("*.md")])


def _made_by(script: str):
    spec = importlib.util.spec_from_file_location(script, REPOSITORY / "scripts" / f"{script}.py")
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    return module


def test_the_reference_is_what_the_code_says() -> None:
    """Remedy: python scripts/make_reference.py"""
    module = _made_by("make_reference")
    assert module.FILE.read_text(encoding="utf-8") == module.reference()


def test_every_service_of_a_node_says_what_it_does() -> None:
    offered = list(_made_by("make_reference").services())
    assert {"driver/enable", "logger/pause"} <= {f"{node}/{name}" for node, name, _, _ in offered}
    assert all(text for _, _, _, text in offered), offered


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_inside_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_of_ours_that_is_named_exists(page: Path) -> None:
    """Modules, tests, scripts and pages by their path from the root or from the package."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    folders = "straightcomp_ros|test|scripts|docs|config|control|model|nodes|bags|hardware|straightness"
    for name in re.findall(rf"`((?:{folders})/[\w/]+\.\w+)`", text):
        assert any((root / name).exists() for root in (REPOSITORY, REPOSITORY / "straightcomp_ros")), name


def test_the_pages_build_without_a_warning(tmp_path: Path) -> None:
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("NOT TESTED: the HTML pages; mkdocs is not installed. Remedy: pip install -e '.[docs]'")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    assert "straightness compensation" in (tmp_path / "index.html").read_text(encoding="utf-8").lower()
