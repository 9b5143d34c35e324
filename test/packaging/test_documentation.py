"""The pages: made from the code where they repeat it, and without a broken link."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted(path for folder in ("docs", ".", "bags") for path in (REPOSITORY / folder).glob("*.md"))


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
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)", page.read_text(encoding="utf-8")):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in _anchors(file), f"{target}#{anchor}"


def _anchors(page: Path) -> set[str]:
    """Those that Markdown's tools give to the headings."""
    headings = re.findall(r"^#+ (.*)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_of_ours_that_is_named_exists(page: Path) -> None:
    """Modules, tests, scripts and pages by their path from the root or from the package."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    folders = "straightcomp_ros|test|scripts|docs|config|control|model|nodes|bags|hardware|straightness"
    for name in re.findall(rf"`((?:{folders})/[\w/]+\.\w+)`", text):
        assert any((root / name).exists() for root in (REPOSITORY, REPOSITORY / "straightcomp_ros")), name


def test_the_overview_leads_to_every_page() -> None:
    linked = set(re.findall(r"\]\((\w+\.md)", (REPOSITORY / "docs" / "index.md").read_text(encoding="utf-8")))
    assert linked == {page.name for page in (REPOSITORY / "docs").glob("*.md")} - {"index.md"}


@pytest.fixture(scope="module")
def build_pages():
    """Runs in a folder what `make docs` runs."""
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("NOT TESTED: the HTML pages; mkdocs is not installed. Remedy: pip install -e '.[docs]'")
    options = re.search(r"-m mkdocs (.*)", (REPOSITORY / "Makefile").read_text(encoding="utf-8"))[1].split()

    def build(folder: Path, site: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "mkdocs", *options, "--site-dir", str(site)]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)

    return build


def test_the_pages_build_without_a_warning(build_pages, tmp_path: Path) -> None:
    built = build_pages(REPOSITORY, tmp_path)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "straightness compensation" in (tmp_path / "index.html").read_text(encoding="utf-8").lower()


@pytest.mark.parametrize("link", ["nowhere.md", "plant.md#nowhere", "../README.md", "images/nowhere.png"])
def test_a_link_that_leads_nowhere_fails_the_build(build_pages, tmp_path: Path, link: str) -> None:
    shutil.copy(REPOSITORY / "mkdocs.yml", tmp_path)
    shutil.copytree(REPOSITORY / "docs", tmp_path / "docs")
    with (tmp_path / "docs" / "view.md").open("a", encoding="utf-8") as page:
        page.write(f"\n[text]({link})\n")
    built = build_pages(tmp_path, tmp_path / "site")
    assert built.returncode != 0
    assert link.partition("#")[0] in built.stderr
