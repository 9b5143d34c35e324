"""docs/paper.md prints what `straightcomp reproduce` computes."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "paper.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in PAGE.partition("## The numbers")[2].partition("\n## ")[0].splitlines()
    if line.startswith("| ") and not line.startswith("| claim")
]


def numbers(cell: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?[\d.]+", cell.replace("−", "-"))]


def of_the_same_row(claims: list[dict], name: str) -> list[dict]:
    """Claims under one heading of the page, which gathers our laws in one row."""
    ours = "each of our laws" in name
    figure = re.match(r"(beyond )?Fig. \d", name)
    found = [one for one in claims if figure is None or one["name"].startswith(figure[0])]
    if ours:
        what = "region of recovery" if "region" in name else "recovers from"
        return [one for one in found if what in one["name"] and "(9)" not in one["name"]]
    return found


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_row_of_the_page_is_a_claim_of_reproduce(row, output):
    name, paper, ours, _, agrees = row
    claims = of_the_same_row(output.printed["claims"], name)
    told = [{"yes": 1.0, "no": 0.0}[ours]] if ours in ("yes", "no") else numbers(ours)
    if "each of our laws" in name:
        found = [claim["ours"] for claim in claims]
        assert [min(found), max(found)] == pytest.approx([min(told), max(told)], abs=0.006)
        return
    near = [claim for claim in claims if claim["ours"] == pytest.approx(told[0], rel=0.05, abs=1e-9)]
    assert near, f"{told[0]} is none of {[claim['ours'] for claim in claims]}"
    if len(told) == 3:
        (claim,) = (claim for claim in near if claim["range"])
        assert list(claim["range"]) == pytest.approx(told[1:], rel=0.06)
    if paper not in ("", "yes", "no"):
        assert any(claim["paper"] == pytest.approx(numbers(paper)[0]) for claim in near)
    if agrees:
        assert any(claim["within"] is agrees.startswith("yes") for claim in near)
