"""Advice: what changed on a stage, the most likely cause, and what helps.

A cause is read from which figures changed, not from how the error did: each wear has a figure of its own (friction as
current, the amplifier's bandwidth, the guide by a sensor, the latency), and moves others less. What changed in the same
week in software, parameters or map is named as the likelier cause, since wear does not wait for an update.

A small JSON file carries a stage's advice to the live view and the OPC UA gateway. `straightcomp history advise` writes
it whole; who reads it finds the old file or the new one:

    {"stage": "gantry", "as_of": "2026-11-24", "advice": [{"cause": "guide", "text": "…", "remedy": "…", …}]}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

import numpy as np

from straightcomp_ros.fleet.maintenance.day_levels import (
    AMPLIFIER,
    BY_NAME,
    ERROR,
    FRICTION,
    GUIDE,
    LATE,
    LATENCY,
    LOST,
    STIFFNESS,
    WATCHED,
    DayLevels,
    median_of,
)
from straightcomp_ros.fleet.maintenance.level_change import LevelChange, Place, changes_of_figure, moved_place

_SAME_TIME = 3
"""Days between an update and a change that it may have made."""
_OF_ITS_OWN = 0.5
"""Relative change of a force, as a fraction of the largest one, from which it is a wear of its own."""
_FORCES = (FRICTION, STIFFNESS, AMPLIFIER)
_TIMES = (LOST, LATENCY, LATE)
_CAUSES = {
    "friction_up": (
        "grease is used up, or dirt lies between slider and platform",
        "clean and regrease the platform's guide; afterwards `straightcomp friction` on a new bag",
    ),
    "friction_down": (
        "fresh grease, or less preload",
        "nothing if it was greased or has run in; otherwise look for a part that has come loose",
    ),
    "stiffness": (
        "the encoder of y changed its scale, or the magnets their bias current or gap",
        "check bias current and gaps of the magnets, then calibrate the encoder of y by an interferometer",
    ),
    "amplifier": (
        "the amplifier ages",
        "check the amplifier and its supply; until it is replaced, find gains for it by `straightcomp design`",
    ),
    "host": (
        "the computer is slower or busier",
        "look at the computer: `straightcomp doctor` there, then `straightcomp bench graph`",
    ),
    "bolt": (
        "something came loose, or was hit",
        "check the bolts of the rail there, then survey the stretch again",
    ),
    "guide": (
        "it settles or wears",
        "survey the stretch again, or look at the map that `straightcomp history map` proposes",
    ),
    "unknown": (
        "no figure of its own says why",
        "compare a new bag with an old one: `straightcomp evaluate NEW --compare OLD`",
    ),
}
"""By name, why a figure is likely to have changed, and the remedy."""
_SETTINGS_REMEDY = "compare with what was set before; take it back if the change was not wanted"


@dataclass(frozen=True)
class Advice:
    """One change that needs work."""

    cause: str  # its name, for programs
    text: str  # what changed, since when, and the likely cause
    remedy: str  # what to do
    since: date  # when it began by the best fit
    found: date  # when the strokes first showed it
    changes: tuple[LevelChange, ...]  # of the figures that it explains, that of the cause first
    place: Place | None = None  # of the guide; None where it has none

    @property
    def due(self) -> bool:
        """Whether it still holds: the figure may have gone back by itself, or after work."""
        return self.changes[0].lasting


def changes_of(levels: DayLevels) -> list[LevelChange]:
    """All changes of all watched figures, in the order of :data:`WATCHED`."""
    return [change for one in WATCHED for change in changes_of_figure(levels.figures[one.name], one)]


def advice_of(levels: DayLevels) -> list[Advice]:
    """The advice from a stage's history, what is due at the head, then the newest; empty for a sound one."""
    advice = [one for group in _together(changes_of(levels)) for one in _matters(levels, group)]
    return sorted(advice, key=lambda one: (one.due, one.found), reverse=True)


def _together(changes: Sequence[LevelChange]) -> list[dict[str, LevelChange]]:
    """Changes by figure in groups that may have a cause in common: those that last, which nothing that went back may
    explain, and of the others those that overlap."""
    groups, until = [{change.figure: change for change in changes if change.ended is None}], 0
    over = [(change.found, change.ended, change) for change in changes if change.ended is not None]
    for found, ended, change in sorted(over, key=lambda one: one[0]):
        if found >= until:
            groups.append({})
        groups[-1].setdefault(change.figure, change)
        until = max(until, ended)
    return [group for group in groups if group]


def _matters(levels: DayLevels, changes: Mapping[str, LevelChange]) -> list[Advice]:
    """One for each cause; what a cause does not stand for is listed with the nearest one."""
    explained: dict[str, list[LevelChange]] = {own: [] for own in _causes(changes)}
    for name, change in changes.items():
        if name not in explained:
            nearest = min(explained, key=lambda own: (_kin(own, name), abs(changes[own].begin - change.begin)))
            explained[nearest].append(change)
    return [_advice(levels, changes[own], others) for own, others in explained.items()]


def _causes(changes: Mapping[str, LevelChange]) -> list[str]:
    """Names of the figures that stand for a cause, the others follow from them."""
    own = [GUIDE] if GUIDE in changes else []
    sizes = {name: abs(_relative(changes[name])) for name in _FORCES if name in changes}
    own += [name for name, size in sizes.items() if size >= _OF_ITS_OWN * max(sizes.values())]
    # One cause for all that the host does: what came first.
    own += sorted((name for name in _TIMES if name in changes), key=lambda name: changes[name].found)[:1]
    # The guide does not move the error that the encoder sees.
    if not set(own) - {GUIDE} and changes.keys() - {GUIDE}:
        own.append(next(name for name in (ERROR, *changes) if name in changes and name != GUIDE))
    return own


def _kin(own: str, other: str) -> int:
    """0 where both are forces or both are times, 1 for other figures, 2 where the guide would explain them."""
    if own == GUIDE:
        return 2
    return 0 if (own in _TIMES) == (other in _TIMES) and (own in _FORCES) == (other in _FORCES) else 1


def _relative(change: LevelChange) -> float:
    return (change.after - change.before) / abs(change.before) if change.before else 0.0


def _update_at(levels: DayLevels, place: int) -> str:
    """What was changed by people within some days of an entry, in words; empty for nothing."""
    near = np.flatnonzero(np.abs(levels.day - levels.day[place]) <= _SAME_TIME).tolist()
    words = []
    for what, values in levels.settings.items():
        for k in near:
            if k and values[k] != values[k - 1]:
                named = f" from {values[k - 1] or 'unknown'} to {values[k] or 'unknown'}" if what == "software" else ""
                words.append(f"{what} changed{named} on {levels.date(k)}")
    return ", ".join(words)


def _advice(levels: DayLevels, change: LevelChange, others: list[LevelChange]) -> Advice:
    name, rose, since, place = change.figure, change.after > change.before, levels.date(change.begin), None
    if name == GUIDE:
        place = moved_place(median_of(levels.shifts[list(change.days)]), levels.x)
        cause = "bolt" if change.step else "guide"
        moved = f"the guide moved from x = {place.first} to {place.last} mm by {change.after:.3g} µm"
    else:
        words = BY_NAME[name]
        part = f"by {abs(_relative(change)):.0%}, " if change.before else ""
        span = f"from {change.before:.3g} to {change.after:.3g} {words.unit}".strip()
        cause = {
            FRICTION: "friction_up" if rose else "friction_down",
            STIFFNESS: "stiffness",
            AMPLIFIER: "amplifier",
            **dict.fromkeys(_TIMES, "host"),
        }.get(name, "unknown")
        moved = f"{words.words} {'rose' if rose else 'fell'} {part}{span}"
    likely, remedy = _CAUSES[cause]
    update = _update_at(levels, change.begin)
    if update and change.step and name != GUIDE:
        likely, remedy = update, f"{_SETTINGS_REMEDY}; {remedy}"
    text = f"{moved}, {'at once' if change.step else 'slowly'}, since {since}: {likely}"
    found = min(levels.date(one.found) for one in (change, *others))
    return Advice(cause, text, remedy, since, found, (change, *others), place)


def advice_json(stage: str, as_of: date, advice: Sequence[Advice]) -> dict[str, Any]:
    """The content of the file: the advice that is due. ``as_of`` is the day of the last stroke that it knows."""
    entries = []
    for one in advice:
        if one.due:
            first, last = one.place or (None, None)
            figures = {change.figure: {"before": change.before, "after": change.after} for change in one.changes}
            said = {"cause": one.cause, "text": one.text, "remedy": one.remedy}
            days = {"since": str(one.since), "found": str(one.found)}
            entries.append({**said, **days, "from_mm": first, "to_mm": last, "figures": figures})
    return {"stage": stage, "as_of": str(as_of), "advice": entries}
