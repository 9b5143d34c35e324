"""Tables of the command line on a narrow terminal: the fixture ``printed_tables_are_whole`` looks at those of all verbs
that any test prints, at 80 columns."""

from io import StringIO

import pytest
from rich.console import Console

from straightcomp_ros.cli.results import doubtful, titled_table

CLAIMS = [
    (
        "Fig. 4: largest overshoot of the platform from its stop, at the lowest bandwidth",
        "0.0123",
        "0.0119",
        "µm",
        "yes",
    ),
    ("(12): observer's pole", "-1234.56789", doubtful("-1.234e-08"), "rad/s", "no"),
    ("a_name_that_is_longer_than_any_line_of_a_narrow_terminal", "0.491 (0.4812 to 0.5021)", "", "", ""),
]


@pytest.mark.parametrize("width", [24, 40, 60, 80, 100, 160])
def test_a_table_shows_each_number_whole_at_any_width(width):
    console = Console(width=width, record=True, file=StringIO())
    headings = ("claim", "paper", "ours", "unit", "within")
    console.print(titled_table("The paper's numbers", *headings, left=("unit", "within"), rows=CLAIMS))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= width
    assert {"0.0123", "0.0119", "-1234.56789", "-1.234e-08", "0.491", "(0.4812", "0.5021)"} <= set(text.split())
    assert "…" not in text
