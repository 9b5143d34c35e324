"""The pages: made from the code where they repeat it, and without a broken link."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scripts import make_reference

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted(path for folder in ("docs", ".", "bags") for path in (REPOSITORY / folder).glob("*.md"))


def test_the_reference_is_what_the_code_says():
    """Remedy: python scripts/make_reference.py"""
    assert make_reference.FILE.read_text(encoding="utf-8") == make_reference.reference()


def test_every_service_of_a_node_says_what_it_does():
    offered = list(make_reference.services())
    assert {"driver/enable", "logger/pause"} <= {f"{node}/{name}" for node, name, _, _ in offered}
    assert all(text for _, _, _, text in offered), offered


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_inside_leads_somewhere_and_every_file_of_ours_that_is_named_exists(page):
    """Modules, tests, scripts and pages by their path from the root or from the package."""
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)", page.read_text(encoding="utf-8")):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in _anchors(file), f"{target}#{anchor}"
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    folders = "straightcomp_ros|test|scripts|docs|config|control|model|nodes|bags|hardware|straightness"
    for name in re.findall(rf"`((?:{folders})/[\w/]+\.\w+)`", text):
        assert any((root / name).exists() for root in (REPOSITORY, REPOSITORY / "straightcomp_ros")), name


def _anchors(page):
    """Those that Markdown's tools give to the headings."""
    headings = re.findall(r"^#+ (.*)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


def test_the_overview_leads_to_every_page():
    linked = set(re.findall(r"\]\((\w+\.md)", (REPOSITORY / "docs" / "index.md").read_text(encoding="utf-8")))
    assert linked == {page.name for page in (REPOSITORY / "docs").glob("*.md")} - {"index.md"}


def test_the_pages_build_without_a_warning_and_a_link_that_leads_nowhere_fails_the_build(tmp_path):
    """What `make docs` runs."""
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("NOT TESTED: the HTML pages; mkdocs is not installed. Remedy: pip install -e '.[docs]'")
    options = re.search(r"-m mkdocs (.*)", (REPOSITORY / "Makefile").read_text(encoding="utf-8"))[1].split()

    def build(folder, site):
        command = [sys.executable, "-m", "mkdocs", *options, "--site-dir", str(site)]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)

    built = build(REPOSITORY, tmp_path / "site")
    assert built.returncode == 0, built.stdout + built.stderr
    shutil.copy(REPOSITORY / "mkdocs.yml", tmp_path)
    shutil.copytree(REPOSITORY / "docs", tmp_path / "docs")
    links = ["nowhere.md", "plant.md#nowhere", "../README.md", "images/nowhere.png"]
    with (tmp_path / "docs" / "view.md").open("a", encoding="utf-8") as page:
        page.writelines(f"\n[text]({link})\n" for link in links)
    built = build(tmp_path, tmp_path / "site")
    assert built.returncode != 0
    assert [link for link in links if link.partition("#")[0] not in built.stderr] == []
