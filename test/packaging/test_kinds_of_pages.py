"""Each page is of one kind, says for whom it is, and those for users in need have every word that a program prints."""

import re

import pytest
import yaml
from places import REPOSITORY, page

from straightcomp_ros.analysis.judgement import WORDS

DOCS = REPOSITORY / "docs"
NAVIGATION = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
TROUBLESHOOTING = page("troubleshooting")


def pages(entries):
    """File names in a section of the navigation, in their order."""
    for entry in entries if isinstance(entries, list) else [entries]:
        if isinstance(entry, dict):
            yield from (page for below in entry.values() for page in pages(below))
        else:
            yield entry


KINDS = {page: kind for section in NAVIGATION for kind, below in section.items() for page in pages(below)}


def test_the_navigation_has_each_page_once_in_four_kinds_after_the_overview():
    assert sorted(pages(NAVIGATION)) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))
    assert list(dict.fromkeys(KINDS.values())) == ["Overview", "Tutorial", "How-to", "Reference", "Explanation"]


@pytest.mark.parametrize("page", sorted(KINDS))
def test_the_first_line_of_a_page_says_its_kind_and_for_whom_it_is(page):
    heading, blank, first = (DOCS / page).read_text(encoding="utf-8").splitlines()[:3]
    assert heading.startswith("# ") and not blank
    assert re.fullmatch(rf"\*{KINDS[page]}, for [^*]+\*", first), first


def test_each_verdict_has_its_row_among_the_symptoms():
    table = TROUBLESHOOTING.partition("## Symptoms of a run\n")[2].partition("\n## ")[0]
    seconds = re.findall(r"^\| .*? \| (.*?) \|", table, re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", " ".join(seconds))) == set(WORDS)
