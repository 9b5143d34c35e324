"""A map from strokes: as good as a fresh survey, with its provenance, and refused where nothing was seen."""

import itertools
from dataclasses import replace
from functools import cache

import pyarrow
import pytest

from straightcomp_ros.fleet.history.rows import StrokeRow, checksum_of, schema_of, table_of
from straightcomp_ros.fleet.maintenance.map_proposal import proposed_map
from straightcomp_ros.stage.due_maintenance import MaintenanceError
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import read_survey
from straightcomp_ros.straightness.survey_header import SurveyError
from trials.wear import followed_map, simulated_rows


@pytest.mark.nightly
def test_on_a_guide_that_moved_a_proposed_map_is_as_good_as_a_fresh_survey(tmp_path):
    figures = followed_map(tmp_path, 0.5, cycles=8)
    assert figures["proposed_to_fresh"] <= 1.1
    assert figures["old_um"]["median"] > 2.0 * figures["fresh_um"]["median"]
    proposed = read_survey(tmp_path / "proposed_map.csv")
    assert len(proposed.runs) == 10 and proposed.facts["proposed from"].startswith("16 strokes")


OLD = find_survey("config/survey_synthetic.csv")
OF_MAP = {"map_checksum": checksum_of([OLD.read_bytes()])}


@cache
def there_and_back():
    """The rows of a stroke each way."""
    return simulated_rows({})


def rows(**changes):
    """Rows of ten strokes each way over a guide that is the map's."""
    unchanged = {"guide_change_um": [0.0] * len(there_and_back()[0].error_bins_um)}
    return table_of(StrokeRow, [replace(row, **(unchanged | changes)) for row in there_and_back() * 10]).to_pylist()


def proposal_of(strokes, *guide, old=OLD):
    return proposed_map(pyarrow.Table.from_pylist(strokes, schema_of(StrokeRow)), old, 7.0, *guide)


def test_strokes_without_a_sensor_or_with_another_map_are_refused():
    with pytest.raises(MaintenanceError, match="displacement sensor: record 'displacement'"):
        proposal_of(rows(guide_change_um=None))
    with pytest.raises(MaintenanceError, match=r"0 whole strokes forward .* 20 with another map"):
        proposal_of(rows(map_checksum="another"))


def test_only_strokes_with_that_map_make_the_proposal():
    """The zero of the guide's change is the map's: strokes with another one say nothing together with these."""
    # A guide that has moved is what a new map is for, a loop that oscillates says nothing of it.
    ours = rows(verdict="wrong_guide", **OF_MAP)
    others = [*rows(), *rows(verdict="oscillates", **OF_MAP)]
    for row in others:
        row["guide_change_um"] = [5.0 * (place > 40) for place in range(len(row["guide_change_um"]))]
    proposal = proposal_of([*ours, *others])
    assert proposal.strokes == len(ours) and peak_to_peak(proposal.change) < 0.1e-6
    with pytest.raises(SurveyError, match="travel"):
        proposal_of([*ours, *others], MapParameters(travel=1e-6))
    provenance = proposal.built.provenance
    assert provenance["made by"].startswith("straightcomp history map")
    assert provenance["proposed from"].startswith(f"{len(ours)} strokes")
    assert provenance["changes"].startswith("map survey_synthetic.csv, BLAKE2b")


def test_a_proposal_is_of_the_old_maps_machine_and_reference_but_not_of_its_day(tmp_path):
    old, new = tmp_path / "old.csv", tmp_path / "new.csv"
    head = "# encoder reference: index 3\n# machine: M1\n# measured: 2025-01-02\n# operator: A. B.\n# sensor: S\n"
    old.write_text(head + OLD.read_text())
    proposal_of(rows(map_checksum=checksum_of([old.read_bytes()])), old=old).built.write(new)
    facts = read_survey(new).facts
    assert (facts["encoder reference"], facts["machine"]) == ("index 3", "M1")
    assert not {"measured", "operator", "sensor"} & facts.keys()


MOVED = [0.5 * (30 <= place < 42) for place in range(170)]
"""µm, of the guide's bins."""


def of_places(*stretches):
    """Ten strokes each way over each stretch of bins, on a straight edge that is not parallel; the zero of each is the
    mean over its own x."""
    found = []
    for first, last in stretches:
        seen = [MOVED[place] + 0.1 * place for place in range(first, last)]
        own = {"bins_from_mm": 10 * first, "guide_change_um": [one - sum(seen) / len(seen) for one in seen]}
        found += [row | own for row in rows(**OF_MAP)]
    return found


def test_jogs_make_no_proposal_and_change_none():
    sound, jogs = of_places((0, 170)), of_places((30, 42))
    found = proposal_of(jogs + sound)
    assert found.strokes == 20 and found.change == pytest.approx(proposal_of(sound).change, abs=1e-12)
    for whole in (4, 2):
        with pytest.raises(
            MaintenanceError, match=rf"{whole} whole strokes forward .* 20 shorter ones, 0 with another"
        ):
            proposal_of(sound[: 2 * whole] + jogs)


@pytest.mark.parametrize("ends", [(0, 85, 170), (0, 43, 128, 170), (0, 17, 34, 51, 68, 85, 102, 119, 136, 153, 170)])
def test_parts_of_a_stroke_make_no_proposal_however_long_they_are(ends):
    """As of a stage that stops on the way: the zero of each part is its own."""
    parts, whole = of_places(*itertools.pairwise(ends)), of_places((0, 170))
    with pytest.raises(MaintenanceError, match="0 whole strokes"):
        proposal_of(parts)
    ways = {
        way: [row for row in of if row["direction"] == way] for of, way in ((parts, "forward"), (whole, "backward"))
    }
    with pytest.raises(MaintenanceError, match="0 whole strokes forward"):
        proposal_of([*ways["forward"], *ways["backward"]])
    assert proposal_of(parts + whole).change == pytest.approx(proposal_of(whole).change, abs=1e-12)


@pytest.mark.parametrize("farther", [(60, 130), (20, 130), (0, 120)])
def test_strokes_that_went_farther_once_change_no_proposal(farther):
    daily, once = of_places((60, 120)), of_places(farther)[:2]
    found = proposal_of(daily + once)
    assert found.strokes == 22 and found.change == pytest.approx(proposal_of(daily).change, abs=1e-9)


def test_a_sensor_that_dropped_out_makes_parts_of_whole_strokes():
    sound = of_places((0, 170))
    dropped = [row | {"guide_change_um": [*row["guide_change_um"][:50], *[None] * 120]} for row in sound[:6]]
    silent = [row | {"guide_change_um": [None] * 170} for row in sound[:6]]
    found = proposal_of(sound + dropped + silent)
    assert found.strokes == 20 and found.change == pytest.approx(proposal_of(sound).change, abs=1e-12)
    for left in (dropped, silent):
        with pytest.raises(MaintenanceError, match="whole strokes forward"):
            proposal_of(left)
