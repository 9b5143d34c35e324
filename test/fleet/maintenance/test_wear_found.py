"""Every alarm that a person would have been told of counts, and nothing that came to be known later."""

import numpy as np
from trials.bench import wear_found

from trials.wear import Alarm, alarms_of
from trials.worn_stage import SOUND, levels_of_months, months

DAYS = np.arange(120)


def test_an_alarm_that_comes_again_counts_again(make_levels):
    spells = ((DAYS >= 40) & (DAYS < 55)) | ((DAYS >= 80) & (DAYS < 95))
    alarms = alarms_of(make_levels(friction_A=1.0 + 0.3 * spells))
    assert [alarm.cause for alarm in alarms] == ["friction_up", "friction_up"]
    assert [alarm.place // 40 for alarm in alarms] == [1, 2]


def test_a_cause_that_was_told_and_then_corrected_counts(make_levels):
    """First the error alone is worse, then the friction that explains it is seen."""
    levels = make_levels(encoder_rms_um=1.0 + 0.5 * (DAYS >= 40), friction_A=1.0 + 0.5 * (DAYS >= 60))
    assert [alarm.cause for alarm in alarms_of(levels)] == ["unknown", "friction_up"]


def test_a_cause_that_comes_to_be_told_while_no_figure_s_alarm_begins_or_ends_counts(make_levels):
    """Stiffness first follows friction, then it has changed so much that it is a matter of its own."""
    stiffness = 1.0 + 0.1 * (DAYS >= 40) + 0.4 * (DAYS >= 80)
    first, second = alarms_of(make_levels(friction_A=1.0 + 0.5 * (DAYS >= 40), stiffness_A_per_m=stiffness))
    assert first == Alarm("friction_up", 40)
    assert second.cause == "stiffness" and second.place >= 80


def test_a_stage_that_only_scatters_raises_none(make_levels):
    assert alarms_of(make_levels()) == []


def test_sound_stages_raise_less_than_one_alarm_a_year(pool):
    years = [levels_of_months(months(pool, SOUND, 0, 365, 900 + seed, bags=4), pool.x) for seed in range(5)]
    assert sum(len(alarms_of(year)) for year in years) <= 5


def test_the_alarm_with_the_right_cause_counts_from_the_wear_s_beginning(monkeypatch, pool):
    wear = next(one for one in wear_found.WEARS if one.name == "friction")
    told = [Alarm("friction_up", 50), Alarm("host", 130), Alarm("friction_up", 170), Alarm("friction_up", 300)]
    monkeypatch.setattr(wear_found, "_levels", lambda *_: None)
    monkeypatch.setattr(wear_found, "alarms_of", lambda _: told)
    assert wear_found.found(pool, wear, 0, True) == (50, 2)
