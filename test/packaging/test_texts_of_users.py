"""Texts of users are never markup, a control sequence, HTML or mathematics, and print in every encoding."""

import io
import os
import subprocess

import pytest
from places import REPOSITORY
from rich.table import Table
from test_command_line import COMMAND
from tiers import nightly

from straightcomp_ros.analysis.html_page import blocks, line_figure
from straightcomp_ros.analysis.pictures import as_text
from straightcomp_ros.cli.output import console, notes, printable, styled
from straightcomp_ros.cli.results import doubtful, titled_table

NAMES = ["gantry[left]", "[/x]", "[red]", "a[bold]b[/bold]", ":smile:", "[link=http://x]y[/]", "\\[x]"]


def printed(monkeypatch, *texts, of=console):
    file = io.StringIO()
    monkeypatch.setattr(of, "_file", file)
    for text in texts:
        of.print(text)
    return file.getvalue()


@pytest.mark.parametrize("of", [console, notes])
@pytest.mark.parametrize("name", NAMES)
def test_a_text_is_printed_as_it_is(name, of, monkeypatch):
    table = titled_table(name, name, name, rows=[(name, doubtful(name))])
    bare = Table(title=name)
    bare.add_column(name)
    bare.add_row(name)
    assert printed(monkeypatch, name, of=of) == f"{name}\n"
    assert printed(monkeypatch, table, of=of).count(name) == 5 and printed(monkeypatch, bare, of=of).count(name) == 3
    assert printed(monkeypatch, styled(("ok", "green"), name), of=of) == f"ok{name}\n"


@pytest.mark.parametrize("of", [console, notes])
def test_a_width_of_zero_is_an_unknown_one(of, monkeypatch):
    monkeypatch.setenv("COLUMNS", "0")
    assert type(of)().width == 80


@pytest.mark.parametrize("control", ["\x1b[2J", "\x1b]0;x\x07", "\r", "\x08", "\x9b2J", "\u202e", "\x7f"])
def test_no_text_controls_the_terminal(control, monkeypatch, verb):
    name = f"a{control}b"
    shown = printed(monkeypatch, name, styled(name), titled_table(name, name, rows=[(name,), (doubtful(name),)]))
    assert control not in shown and printable(name) in shown
    for words in (["evaluate", name], ["simulate", "--plot", f"{name}/run.png"], [name]):
        found = verb(*words)
        assert found.code in (1, 2) and control not in found.err


ODD = "evaluate none-µ-\udcff-轴"


@pytest.mark.parametrize(
    ("words", "encoding"),
    [(ODD, "ascii"), (ODD, "utf-8"), ("stage show SHIPPED", "ascii"), *nightly([("stage show SHIPPED", "utf-8")])],
)
def test_every_text_prints_in_every_encoding(words, encoding, tmp_path):
    command = words.replace("SHIPPED", str(REPOSITORY / "config" / "stage_synthetic.yaml")).split()
    done = subprocess.run(
        [*COMMAND, *map(os.fsencode, command)],
        env={**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"},
        capture_output=True,
        cwd=tmp_path,
        timeout=120,
    )
    assert b"Traceback" not in done.stderr and done.returncode in (0, 1, 2)
    (done.stdout + done.stderr).decode(encoding)


def test_plotly_takes_no_text_for_html():
    figure = line_figure("x", "<b>y</b>")
    figure.add_scatter(x=[0, 1], y=["<i>fault</i>", "a&lt;b"], name="<a href='x'>bag</a>", text=["<b>", "</script>"])
    figure.add_annotation(text="<b>corner</b>")
    page = blocks.plots([figure])
    for tag in ("<b>", "<i>", "<a href"):
        assert tag not in page and tag.replace("<", "\\u003c").replace(">", "\\u003e") not in page
    assert page.count("</script>") == page.count("<script")


@pytest.mark.parametrize("name", ["a$b$", "a$b", "$$", r"\frac{$", r"$\frac{1}$", r"\$x$", "a\\b", "$_$^{", "a\udcff"])
def test_matplotlib_draws_a_text_as_it_is(name, tmp_path):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure()
    FigureCanvasAgg(figure)
    drawn = figure.suptitle(as_text(name))
    figure.savefig(tmp_path / "picture.png")
    assert drawn._preprocess_math(as_text(name)) == (name.replace("\udcff", r"\udcff"), False)
