"""A map from strokes: as good as a fresh survey, with its provenance, and refused where nothing was seen."""

from dataclasses import replace

import pyarrow
import pytest

from straightcomp_ros.fleet.history.rows import StrokeRow, checksum_of, schema_of, table_of
from straightcomp_ros.fleet.maintenance.map_proposal import proposed_map
from straightcomp_ros.stage.due_maintenance import MaintenanceError
from straightcomp_ros.straightness.guide_map import find_survey
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import read_survey
from trials.wear import BASE, followed_map


@pytest.mark.nightly
def test_on_a_guide_that_moved_a_proposed_map_is_as_good_as_a_fresh_survey(tmp_path):
    figures = followed_map(tmp_path, 0.5, cycles=8)
    assert figures["proposed_to_fresh"] <= 1.1
    assert figures["old_um"]["median"] > 2.0 * figures["fresh_um"]["median"]
    proposed = read_survey(tmp_path / "proposed_map.csv")
    assert len(proposed.runs) == 10 and proposed.facts["proposed from"].startswith("16 strokes")


def rows(pool, **changes):
    sound = pool[BASE]
    guide = [0.0] * len(sound[0].error_bins_um)
    return table_of(StrokeRow, [replace(row, guide_change_um=guide, **changes) for row in sound * 10])


def test_strokes_without_a_sensor_or_with_another_map_are_refused(pool):
    old = find_survey("config/survey_synthetic.csv")
    with pytest.raises(MaintenanceError, match="displacement sensor: record 'displacement'"):
        proposed_map(table_of(StrokeRow, pool[BASE]), old, 7.0)
    with pytest.raises(MaintenanceError, match=r"0 strokes forward .* 20 with another map"):
        proposed_map(rows(pool, map_checksum="another"), old, 7.0)


def test_only_strokes_with_that_map_make_the_proposal(pool):
    """The zero of the guide's change is the map's: strokes with another one say nothing together with these."""
    old = find_survey("config/survey_synthetic.csv")
    # A guide that has moved is what a new map is for, a loop that oscillates says nothing of it.
    of_map = {"map_checksum": checksum_of([old.read_bytes()])}
    ours = rows(pool, verdict="wrong_guide", **of_map).to_pylist()
    others = [*rows(pool).to_pylist(), *rows(pool, verdict="oscillates", **of_map).to_pylist()]
    for row in others:
        row["guide_change_um"] = [5.0 * (place > 40) for place in range(len(row["guide_change_um"]))]
    mixed = pyarrow.Table.from_pylist([*ours, *others], schema_of(StrokeRow))
    proposal = proposed_map(mixed, old, 7.0)
    assert proposal.strokes == len(ours) and peak_to_peak(proposal.change) < 0.1e-6
    provenance = proposal.built.provenance
    assert provenance["made by"].startswith("straightcomp history map")
    assert provenance["proposed from"].startswith(f"{len(ours)} strokes")
    assert provenance["changes"].startswith("map survey_synthetic.csv, BLAKE2b")
