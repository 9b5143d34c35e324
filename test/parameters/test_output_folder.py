"""What was made in an output folder is replaced, everything else is kept."""

import os
import shutil

import pytest

from straightcomp_ros.parameters.output_files import UNFINISHED, OutputRefused, making


def make(folder, text="new", **how):
    with making(folder, ("bag", "run.png"), **how) as place:
        (place / "bag").mkdir(exist_ok=True)
        (place / "bag" / "bag_0.mcap").write_text(text)
        (place / "run.png").write_text(text)


def kept(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("[!.]*") if path.is_file()}


@pytest.mark.parametrize("anew", [True, False])
def test_what_was_made_is_replaced_unasked(tmp_path, anew):
    make(tmp_path, "old")
    make(tmp_path, anew=anew)
    assert kept(tmp_path) == {"bag/bag_0.mcap": "new", "run.png": "new"}


def added(folder):
    (folder / "bag" / "notes.txt").write_text("mine")


def changed(folder):
    (folder / "run.png").write_text("mine!")


def moved_there(folder):
    shutil.rmtree(folder / "bag")
    shutil.copytree(folder / "recording", folder / "bag")


def copied(folder):
    for path in list(folder.rglob("*.mcap")):
        os.utime(path, (1, 1))


def without_a_mark(folder):
    (folder / ".straightcomp_made.json").unlink()


def with_a_mark_of_nonsense(folder):
    (folder / ".straightcomp_made.json").write_text("[")


@pytest.mark.parametrize("anew", [True, False])
@pytest.mark.parametrize("done", [added, changed, moved_there, copied, without_a_mark, with_a_mark_of_nonsense])
def test_what_was_not_made_here_is_kept_unless_it_is_asked_for(tmp_path, done, anew):
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "bag_0.mcap").write_text("years")
    make(tmp_path, "old")
    done(tmp_path)
    before = kept(tmp_path)
    with pytest.raises(OutputRefused, match="--force"):
        make(tmp_path, anew=anew)
    assert kept(tmp_path) == before
    make(tmp_path, force=True, anew=anew)
    assert kept(tmp_path)["bag/bag_0.mcap"] == "new" and kept(tmp_path)["recording/bag_0.mcap"] == "years"


@pytest.mark.parametrize("read", ["bag", "bag/bag_0.mcap", "link", "run.png"])
def test_what_is_read_is_never_replaced(tmp_path, read):
    make(tmp_path, "old")
    (tmp_path / "link").symlink_to("bag")
    with pytest.raises(OutputRefused, match="is read"):
        make(tmp_path, reads=[tmp_path / read], force=True)
    assert kept(tmp_path)["run.png"] == "old"


def test_a_run_that_fails_leaves_the_former_results_and_its_own_beside_them(tmp_path):
    make(tmp_path, "old")
    with pytest.raises(ZeroDivisionError), making(tmp_path, ("bag", "run.png")) as place:
        (place / "run.png").write_text("half")
        raise ZeroDivisionError
    assert kept(tmp_path) == {"bag/bag_0.mcap": "old", "run.png": "old", f"{UNFINISHED}/run.png": "half"}
    make(tmp_path)
    assert kept(tmp_path) == {"bag/bag_0.mcap": "new", "run.png": "new"}


def test_two_runs_do_not_write_to_one_folder(tmp_path):
    with making(tmp_path, ["bag"]), pytest.raises(OutputRefused, match="another"):
        make(tmp_path)


def test_a_folder_of_the_user_is_not_taken_for_that_of_an_unfinished_run(tmp_path):
    (tmp_path / UNFINISHED).mkdir()
    (tmp_path / UNFINISHED / "thesis").write_text("mine")
    with pytest.raises(OutputRefused):
        make(tmp_path)
    assert kept(tmp_path) == {f"{UNFINISHED}/thesis": "mine"}
