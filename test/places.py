"""Where the files of the repository are, and what its pages say."""

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
BAGS = REPOSITORY / "bags"
SMC = BAGS / "smc"


def page(name: str) -> str:
    """The text of docs/NAME.md."""
    return (REPOSITORY / "docs" / f"{name}.md").read_text(encoding="utf-8")


def line_of(text: str, start: str) -> str:
    """The only row of the tables in ``text`` that begins with these cells."""
    (line,) = (line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return line


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]
