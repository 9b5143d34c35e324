"""Advice: what changed on a stage, the most likely cause, and what helps.

A cause is read from which figures changed, not from how the error did: each wear has a figure of its own (friction as
current, the amplifier's bandwidth, the guide by a sensor, the latency), and moves others less. What changed in the same
week in software, parameters or map is named as the likelier cause, since wear does not wait for an update.

A small JSON file carries a stage's advice to the live view and the OPC UA gateway. `straightcomp history advise` writes
it whole; who reads it finds the old file or the new one:

    {"stage": "gantry", "as_of": "2026-11-24", "advice": [{"cause": "guide", "text": "…", "remedy": "…", …}]}
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
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
    Array,
    DayLevels,
)
from straightcomp_ros.fleet.maintenance.level_change import (
    LevelChange,
    Place,
    changes_of_figure,
    guide_shifts,
    moved_place,
)
from straightcomp_ros.parameters.output_files import plain, write_whole

_SAME_TIME = 3
"""Days between an update and a change that it may have made."""
_OF_ITS_OWN = 0.5
"""Relative change of a force, as a fraction of the largest one, from which it is a wear of its own."""
_FORCES = (FRICTION, STIFFNESS, AMPLIFIER)
_TIMES = (LOST, LATENCY, LATE)
_REMEDIES = {
    "friction_up": "clean and regrease the platform's guide; afterwards `straightcomp friction` on a new bag",
    "friction_down": "nothing if it was greased or has run in; otherwise look for a part that has come loose",
    "stiffness": "check bias current and gaps of the magnets, then calibrate the encoder of y by an interferometer",
    "amplifier": "check the amplifier and its supply; until it is replaced, find gains for it by `straightcomp design`",
    "host": "look at the computer: `straightcomp doctor` there, then `straightcomp bench graph`",
    "bolt": "check the bolts of the rail there, then survey the stretch again",
    "guide": "survey the stretch again, or look at the map that `straightcomp history map` proposes",
    "unknown": "compare a new bag with an old one: `straightcomp evaluate NEW --compare OLD`",
    "settings": "compare with what was set before; take it back if the change was not wanted",
}

_LIKELY = {
    "friction_up": "grease is used up, or dirt lies between slider and platform",
    "friction_down": "fresh grease, or less preload",
    "stiffness": "the encoder of y changed its scale, or the magnets their bias current or gap",
    "amplifier": "the amplifier ages",
    "host": "the computer is slower or busier",
    "unknown": "no figure of its own says why",
}


@dataclass(frozen=True)
class Advice:
    """One change that needs work.

    Attributes:
        cause: its name, for programs.
        text: what changed, since when, and the likely cause.
        remedy: what to do.
        since, found: when it began by the best fit, and when the strokes first showed it.
        changes: of the figures that it explains, that of the cause first.
        place: of the guide; None where it has none.
    """

    cause: str
    text: str
    remedy: str
    since: date
    found: date
    changes: tuple[LevelChange, ...]
    place: Place | None = None

    @property
    def due(self) -> bool:
        """Whether it still holds: the figure may have gone back by itself, or after work."""
        return self.changes[0].lasting


def changes_of(levels: DayLevels) -> list[LevelChange]:
    """All changes of all watched figures, in the order of :data:`WATCHED`."""
    known = all_figures(levels)
    return [change for one in WATCHED for change in changes_of_figure(known[one.name], one)]


def all_figures(levels: DayLevels) -> dict[str, Array]:
    """The levels of all watched figures, (n,) each, that of the guide among them."""
    shifts = guide_shifts(levels.profiles["guide_change_um"], levels.x)
    size = np.full(len(levels.day), np.nan)
    measured = np.isfinite(shifts).any(axis=1)
    size[measured] = np.nanmax(shifts[measured], axis=1) - np.nanmin(shifts[measured], axis=1)
    return {GUIDE: size, **levels.figures}


def advice_of(levels: DayLevels) -> list[Advice]:
    """The advice from a stage's history, what is due at the head, then the newest; empty for a sound one."""
    advice = [one for group in _together(changes_of(levels)) for one in _matters(levels, group)]
    return sorted(advice, key=lambda one: (one.due, one.found), reverse=True)


def _together(changes: Sequence[LevelChange]) -> list[dict[str, LevelChange]]:
    """Changes by figure in groups that may have a cause in common: those that last, which nothing that went back may
    explain, and of the others those that overlap."""
    groups = [{change.figure: change for change in changes if change.lasting}]
    over: list[LevelChange] = []
    for change in sorted((one for one in changes if not one.lasting), key=lambda one: one.found):
        if not over or change.found >= max(_end(one) for one in over):
            groups.append({})
            over = []
        groups[-1].setdefault(change.figure, change)
        over.append(change)
    return [group for group in groups if group]


def _end(change: LevelChange) -> float:
    return math.inf if change.ended is None else change.ended


def _matters(levels: DayLevels, changes: Mapping[str, LevelChange]) -> list[Advice]:
    """One for each cause; what a cause does not stand for is listed with the nearest one."""
    explained: dict[str, list[LevelChange]] = {own: [] for own in _causes(changes)}
    for name, change in changes.items():
        if name not in explained:
            nearest = min(explained, key=lambda own: (_kin(own, name), abs(changes[own].begin - change.begin)))
            explained[nearest].append(change)
    return [
        _advice(levels, changes[own], _update_at(levels, changes[own].begin), others)
        for own, others in explained.items()
    ]


def _causes(changes: Mapping[str, LevelChange]) -> list[str]:
    """Names of the figures that stand for a cause, the others follow from them."""
    own = [GUIDE] if GUIDE in changes else []
    sizes = {name: abs(_relative(changes[name])) for name in _FORCES if name in changes}
    own += [name for name, size in sizes.items() if size >= _OF_ITS_OWN * max(sizes.values())]
    # One cause for all that the host does: what came first.
    late = sorted((changes[name].found, k) for k, name in enumerate(_TIMES) if name in changes)
    own += [_TIMES[late[0][1]]] if late else []
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
    day = levels.day[place]
    words = []
    for what, values in (("software", levels.software), ("map", levels.map), ("parameters", levels.parameters)):
        for k in range(1, len(values)):
            if values[k] != values[k - 1] and abs(int(levels.day[k] - day)) <= _SAME_TIME:
                named = f" from {values[k - 1] or 'unknown'} to {values[k] or 'unknown'}" if what == "software" else ""
                words.append(f"{what} changed{named} on {levels.date(k)}")
    return ", ".join(words)


def _advice(levels: DayLevels, change: LevelChange, update: str, others: list[LevelChange]) -> Advice:
    name, rose = change.figure, change.after > change.before
    since = levels.date(change.begin)
    way = "at once" if change.step else "slowly"
    place = None
    if name == GUIDE:
        shifts = guide_shifts(levels.profiles["guide_change_um"], levels.x)
        measured = np.flatnonzero(np.isfinite(shifts).any(axis=1))
        place = moved_place(np.asarray(np.nanmedian(shifts[measured[-7:]], axis=0)), levels.x)
        cause = "bolt" if change.step else "guide"
        stretch = f"from x = {place.first} to {place.last} mm " if place else ""
        text = f"the guide moved {stretch}by {change.after:.3g} µm, {way}, since {since}"
        likely = "something came loose, or was hit" if change.step else "it settles or wears"
    else:
        words = BY_NAME[name]
        moved = f"by {abs(_relative(change)):.0%}, " if change.before else ""
        moved += f"from {change.before:.3g} to {change.after:.3g} {words.unit}".strip()
        text = f"{words.words} {'rose' if rose else 'fell'} {moved}, {way}, since {since}"
        cause = {
            FRICTION: "friction_up" if rose else "friction_down",
            STIFFNESS: "stiffness",
            AMPLIFIER: "amplifier",
            **dict.fromkeys(_TIMES, "host"),
        }.get(name, "unknown")
        likely = _LIKELY[cause]
    remedy = _REMEDIES[cause]
    if update and change.step and cause not in ("bolt", "guide"):
        likely, remedy = update, f"{_REMEDIES['settings']}; {remedy}"
    found = min(levels.date(one.found) for one in (change, *others))
    return Advice(cause, f"{text}: {likely}", remedy, since, found, (change, *others), place)


def advice_json(stage: str, as_of: date, advice: Sequence[Advice]) -> dict[str, Any]:
    """The content of the file: the advice that is due. ``as_of`` is the day of the last stroke that it knows."""
    return plain({"stage": stage, "as_of": str(as_of), "advice": [_entry(one) for one in advice if one.due]})  # type: ignore[no-any-return]


def write_advice(path: Path, content: dict[str, Any]) -> None:
    """Write :func:`advice_json`; OSError if that is impossible."""
    write_whole(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _entry(advice: Advice) -> dict[str, Any]:
    return {
        "cause": advice.cause,
        "text": advice.text,
        "remedy": advice.remedy,
        "since": str(advice.since),
        "found": str(advice.found),
        "from_mm": advice.place.first if advice.place else None,
        "to_mm": advice.place.last if advice.place else None,
        "figures": {change.figure: {"before": change.before, "after": change.after} for change in advice.changes},
    }
