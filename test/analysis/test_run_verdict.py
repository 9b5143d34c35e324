"""Each verdict on a made-up run, and the nearest run that is in order."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from straightcomp_ros.analysis.interruption import Stall
from straightcomp_ros.analysis.judged_motion import GuideFit, JudgedMotion, Left, destabilised, encoder_count
from straightcomp_ros.analysis.judged_motion import bounds_of as all_bounds
from straightcomp_ros.analysis.judgement import WORDS, Verdict, worst
from straightcomp_ros.analysis.record import runs_of
from straightcomp_ros.analysis.run_verdict import judged_motion, late_commands, verdict_of
from straightcomp_ros.offline.promise import Promise
from straightcomp_ros.stage.description import StageParameters

T = 5e-4
TIME = np.arange(16_000) * T
R = 10e-6 * np.sin(2.0 * np.pi * 0.3 * TIME)
SMALL = 0.05e-6 * np.sin(2.0 * np.pi * 0.9 * TIME)
FITS = GuideFit(20e-6, 0.15e-6)


def motion(error=SMALL, r=R, **changes) -> JudgedMotion:
    values = {
        "time": TIME,
        "x": np.linspace(0.0, 1.76, TIME.size),
        "y": r - error,
        "r": r,
        "current": np.zeros_like(TIME),
        "error": error,
        "count": 0.1e-6,
        "fit": FITS,
    }
    return JudgedMotion(**{**values, **changes})


def bump(at: float, height: float, length: float = 0.02) -> np.ndarray:
    return height * np.exp(-0.5 * ((TIME - at) / length) ** 2)


def sine(frequency: float) -> np.ndarray:
    return np.sin(2.0 * np.pi * frequency * TIME)


def stalled(*error: object, **changes) -> JudgedMotion:
    return motion(*error, stalls=(Stall(3.95, 4.02),), **changes)


MANY, OFTEN = (tuple(Stall(t, t + 0.01) for t in np.arange(0.0, 8.0, every).tolist()) for every in (0.1, 0.15))
PUSHED, SHORTLY = np.where(TIME < 1.0, 0.9, 0.1), np.where(np.abs(TIME - 4.0) < 0.1, 0.9, 0.1)
OTHER, NEARLY_RIGHT = GuideFit(20e-6, 27e-6, "shift it"), GuideFit(20e-6, 0.3e-6, "survey more points")
SPEED = 0.5 * np.abs(np.sin(np.pi * TIME / 4.0))
THERE_AND_BACK = np.cumsum(np.where(TIME < 4.0, SPEED, -SPEED)) * T
WAVES = 0.4e-6 * np.sin(2.0 * np.pi * THERE_AND_BACK / 0.01)
AND_A_JOG = np.interp(TIME, 0.875 * TIME, THERE_AND_BACK) + 1e-4 * np.clip((TIME - 7.5) / 0.03, 0.0, 1.0)
JOGGED = 0.4e-6 * np.sin(2.0 * np.pi * AND_A_JOG / 0.01)
SHORT_RAMPS = [np.cumsum(0.44 * np.clip(8.0 * np.sin(np.pi * TIME / 4.0), -1.0, 1.0)) * T]
SHORT_RAMPS.append(0.4e-6 * np.sin(2.0 * np.pi * SHORT_RAMPS[0] / 0.01))
EVERY = np.arange(TIME.size)
LEFT = EVERY % 97 != 0
NINETY_SIX_OF_97 = {"time": TIME[LEFT], "x": 0.22 * TIME[LEFT], "current": np.zeros(LEFT.sum())}
STEPS = 0.5e-6 * np.cumsum(np.select([EVERY % 400 == 0, EVERY % 200 == 0], [1, -1], 0))
BURSTS = 0.5e-6 * sine(120.0) * np.exp(-0.5 * ((TIME % 0.5 - 0.25) / 0.02) ** 2)
RARELY = 0.5e-6 * sine(120.0) * np.exp(-0.5 * ((TIME % 2.0 - 1.0) / 0.01) ** 2)
# Noise behind a resonance of 30 Hz and 5 %.
DECAYS = np.exp((2j - 0.1) * np.pi * 30.0 * T)
SHAKEN = 0.4e-6 * lfilter([0.1], [1.0, -DECAYS], np.random.default_rng(1).standard_normal(TIME.size)).real
SLOW = 0.4e-6 * np.sin(2.0 * np.pi * 0.17 * TIME + 1.0)
DRAGGED = 0.4e-6 * np.clip(3.0 * np.cos(2.0 * np.pi * 0.3 * TIME), -1.0, 1.0)
NOISE = np.random.default_rng(1).normal(0.0, 0.05e-6, TIME.size)
AT_TURNS = sum(bump(turn, 0.5e-6) for turn in np.arange(0.5, 4.8, 1.0) / 0.6)
OF_PLACE = 0.4e-6 * np.sin(2.0 * np.pi * THERE_AND_BACK / 0.07) * np.where(TIME < 4.0, 1.0, -1.0)
TURNED = 0.4e-6 * np.sin(2.0 * np.pi * AND_A_JOG / 0.07) * np.where(TIME < 3.5, 1.0, -1.0)
IN_TURN = 0.1 * np.clip(np.abs(TIME - 4.0), 0.5, None)


def promised(smooth: float, as_mapped: float = 0.0, largest: float = 0.0, rms: float = 1.0):
    left = [Left(pp * 1e-6, rms * 1e-6) for pp in (smooth, largest, as_mapped or smooth)]
    return lambda: Promise(left[0], lambda enough: left[1], lambda: left[2])


PAUSED = np.cumsum(np.select([TIME < 3.0, TIME < 5.0], [0.5, 0.0], -0.5)) * T
HIDDEN = 0.1 * SMALL + 0.06e-6 * sine(137.0)
NEARLY = 0.02 * R
GENTLE, JOG = 5e-9 * np.sin(TIME), {"fit": None, "map_pp": 20e-6}
SHORT_STEPS = np.where((TIME > 3.0) & (TIME < 5.0), 0.1 * STEPS, SMALL)
LIMITED, DESTABILISED = {"current_limit": 0.9}, {"modes": (80.0,), "destabilised": lambda: True}
DRY = {"y": R, "current": 0.05 * np.sign(np.gradient(R)), "current_stiffness": 40.0}
STROKE_AND_JOG = 0.2 * np.clip(TIME, 0.0, 6.0) - 0.2 * np.clip(TIME - 7.0, 0.0, 0.2)
QUICK_JOG = 1e-4 * np.clip((TIME - 2.0) / 4e-3, 0.0, 1.0)
# What the case shows: (verdict, what its reason says, run), ... Without bounds everything is allowed.
CASES = {
    "a small error is in order": [("in_order", "0.1 µm p-p.*20 µm", motion())],
    "an error made in a stall is the host's, and without the stall it is the law's": [
        ("starved", r"\b70.0 ms.*2.02 µm|2.02 µm.*\b70.0 ms", stalled(SMALL + bump(4.0, 2e-6))),
        ("in_order", "", motion(SMALL + bump(4.0, 2e-6))),
        ("in_order", "", motion(SMALL + bump(4.0, 2e-6), stalls=(Stall(6.0, 6.07),))),
    ],
    "a stall that did no harm": [
        ("in_order", "", motion(stalls=(Stall(4.0, 4.1),))),
        ("in_order", r"without the stalls of the host \(1\)", stalled(SMALL + bump(4.0, 0.09e-6))),
    ],
    "a doubled error within a count of the encoder is no harm": [
        ("starved", "", stalled(SMALL + bump(4.0, 0.3e-6))),
        ("in_order", "", stalled(SMALL + bump(4.0, 0.3e-6), count=1e-6)),
    ],
    "a loop that fails without its stalls too has another reason": [
        ("oscillates", "30 Hz", stalled(3e-6 * sine(30.0) + bump(4.0, 30e-6), 0.2 * R, fit=None)),
        ("starved", "", stalled(0.01 * (3e-6 * sine(30.0) + bump(4.0, 30e-6)), 0.2 * R, fit=None)),
    ],
    "a run of stalls is starved only if its figures are bad": [
        ("starved", "(?=.*disturbed 100%).*stands still", motion(R, stalls=MANY)),
        ("in_order", "", motion(stalls=MANY)),
        ("starved", "error 2.02 µm p-p", motion(SMALL + bump(4.0, 2e-6, 0.005), stalls=MANY)),
        ("in_order", "", motion(SMALL + bump(4.0, 0.15e-6, 0.005), stalls=MANY)),
    ],
    "no error without stalls is stated that leave less than half of the travel": [
        ("starved", "^(?!.*works).*less than half", motion(SMALL + bump(3.95, 2e-6, 0.005), stalls=OFTEN)),
        ("in_order", r"\(\d+\) included", motion(SMALL + bump(3.95, 0.15e-6, 0.005), stalls=OFTEN)),
    ],
    "a platform that reached its stop is at the stop whatever else": [
        ("at_stop", "a mode that nobody described", motion(R - 1.2e-3, stop=1.2e-3)),
        ("in_order", "", motion(y=np.full_like(R, 1.1e-3), stop=1.2e-3)),
        ("in_order", "", motion(y=np.full_like(R, 1.2e-3))),
    ],
    "a stage beyond survey and run-out left the map": [
        ("in_order", "", motion(span=(-0.02, 1.76))),
        ("left_map", "-20 mm to 1750 mm", motion(span=(-0.02, 1.75))),
        ("left_map", "", motion(span=(0.001, 2.0))),
    ],
    "a law that stays at its limit is saturated and one that touches it is not": [
        ("saturated", "0.9 A", motion(current=PUSHED, **LIMITED)),
        ("in_order", "", motion(current=np.where(TIME % 1.0 < 0.01, 0.9, 0.1), **LIMITED)),
        ("in_order", "", motion(current=PUSHED, current_limit=1.0)),
    ],
    "a short stay at the limit counts if the error is made there": [
        ("in_order", "", motion(current=SHORTLY, **LIMITED)),
        ("saturated", "", motion(SMALL + bump(4.0, 2e-6), current=SHORTLY, **LIMITED)),
    ],
    "an oscillation that reaches both limits in turn oscillates": [
        ("oscillates", "(?=.*40 Hz).*100 µm", motion(1e-4 * sine(40.0), current=0.9 * np.sign(sine(40.0)), **LIMITED)),
    ],
    "a map that leaves more of the guide than counts and described noise is not of this guide": [
        ("wrong_guide", "shift it", motion(fit=OTHER)),
        ("wrong_guide", "0.3 µm; allowed: 0.2 µm; survey more points", motion(fit=NEARLY_RIGHT)),
        *(("in_order", "", motion(fit=NEARLY_RIGHT, **known)) for known in ({"count": 0.2e-6}, {"map_noise": 0.05e-6})),
        ("in_order", "", motion(fit=None)),
    ],
    "a platform that does not follow says nothing about the map": [("inaccurate", "", motion(R, fit=OTHER))],
    "an oscillation counts from a count of the encoder and a share of the error on": [
        case
        for line in (12.0, 137.0)
        for case in (
            ("oscillates", f"{line:.0f} Hz", motion(SMALL + 0.15e-6 * sine(line))),
            ("in_order", "", motion(SMALL + 0.08e-6 * sine(line))),
            ("in_order", "", motion(SMALL + 0.15e-6 * sine(line), count=1e-6)),
            ("in_order", "", motion(16.0 * SMALL + 0.15e-6 * sine(line))),
        )
    ],
    "samples that are missing do not hide an oscillation": [
        ("oscillates", "137 Hz", motion((SMALL + 0.3e-6 * sine(137.0))[LEFT], R[LEFT], **NINETY_SIX_OF_97)),
    ],
    "a line at the frequency of the law's own dither is no oscillation of the loop": [
        ("in_order", "", motion(HIDDEN, r=0.1 * R, count=1e-9, fit=None, dither=137.0)),
        ("oscillates", "", motion(HIDDEN, r=0.1 * R, count=1e-9, fit=None, dither=170.0)),
    ],
    "a fine encoder does not make an oscillation of what the guide hides": [
        ("in_order", "", motion(HIDDEN, count=1e-9)),
        ("oscillates", "", motion(HIDDEN, r=0.1 * R, count=1e-9, fit=None)),
    ],
    "a line of the mains is told from one of the loop by its frequency, and by its phase if it wanders": [
        ("mains", r"hum of 50\.\d Hz.*control.filters.mains", motion(SMALL + 0.3e-6 * sine(50.05))),
        ("mains", r"hum of 360\.\d Hz", motion(SMALL + 0.3e-6 * sine(360.1))),
        ("oscillates", "51 Hz", motion(SMALL + 0.3e-6 * sine(51.0))),
        ("oscillates", "", motion(SMALL + 0.3e-6 * np.sin(2.0 * np.pi * 50.0 * TIME + 5.0 * SMALL / 0.05e-6))),
    ],
    "a line of the mains is there at rest too, and one of few whole samples has another of their comb": [
        ("oscillates", "250 Hz", motion(SMALL + 0.3e-6 * sine(250.0))),
        ("mains", "hum of 250", motion(SMALL + 0.3e-6 * sine(250.0) + 0.05e-6 * sine(50.0))),
        ("mains", r"hum of 50\.\d Hz", motion(SMALL + NOISE + 0.5e-6 * sine(50.05), x=IN_TURN)),
        ("oscillates", "50 Hz", motion(SMALL + NOISE + 0.5e-6 * sine(50.05) * (np.abs(TIME - 4.0) > 0.5), x=IN_TURN)),
    ],
    "waves over x are locked to it, whatever their frequency": [
        ("locked_to_x", "every 10 mm of x.*learning.learn", motion(SMALL + WAVES, x=THERE_AND_BACK - 1.0, r=0.1 * R)),
        ("oscillates", "", motion(SMALL + 0.4e-6 * sine(44.0), x=THERE_AND_BACK)),
        # A jog is too short for waves.
        ("locked_to_x", "every 10 mm of x", motion(SMALL + JOGGED, x=AND_A_JOG + 1.0, r=0.1 * R)),
        ("locked_to_x", "every 10 mm of x", motion(SMALL + SHORT_RAMPS[1], x=SHORT_RAMPS[0], r=0.1 * R)),
        ("oscillates", "", motion(SMALL + 0.4e-6 * sine(44.0), x=SHORT_RAMPS[0], r=0.1 * R)),
    ],
    "a platform that stands and jumps sticks and slips": [
        ("stick_slip", "^(?!.*lower the static)", motion(STEPS, promise=promised(0.05))),
        ("stick_slip", "lower the static friction", motion(STEPS, promise=promised(0.05), coulomb=0.4)),
        ("in_order", "", motion(STEPS, promise=promised(0.3))),
    ],
    "a loop that oscillates in bursts neither stands nor jumps": [
        ("vibration", "hardly any margins", motion(BURSTS, promise=promised(0.05))),
        ("inaccurate", "comes in bursts.*stage.drive.delay", motion(RARELY, promise=promised(0.05))),
    ],
    "jumps through a pause are hunting, and one that ends with its first half is settling": [
        ("stick_slip", "at rest", motion(np.where((TIME > 3.0) & (TIME < 5.0), STEPS, SMALL), x=PAUSED)),
        ("in_order", "", motion(np.where((TIME > 3.3) & (TIME < 3.4), 0.5e-6, SMALL), x=PAUSED)),
    ],
    "a line at a described mode is the mode's, and so is all of a loop that has no margins because of its modes": [
        ("resonance", "mode at 135 Hz", motion(SMALL + 0.3e-6 * sine(137.0), modes=(80.0, 135.0))),
        ("oscillates", "", motion(SMALL + 0.3e-6 * sine(137.0), modes=(80.0,))),
        ("resonance", "at 80 Hz leave", motion(SMALL + 0.3e-6 * sine(137.0), **DESTABILISED)),
        ("resonance", "at 80 Hz leave", motion(STEPS, promise=promised(0.05), **DESTABILISED)),
        ("in_order", "", motion(**DESTABILISED)),
    ],
    "a line that comes and goes is a vibration, but of a loop that begins to oscillate, or is at its limit": [
        ("vibration", "shaken at 3. Hz", motion(SMALL + SHAKEN)),
        ("oscillates", "30 Hz", motion(SMALL + 0.4e-6 * sine(30.0))),
        ("oscillates", "30 Hz", motion(SMALL + 0.4e-6 * sine(30.0) * np.clip((TIME - 2.0) / 2.0, 0.01, 1.0))),
        ("oscillates", "", motion(SMALL + SHAKEN, current=0.9 * np.sign(SHAKEN), **LIMITED)),
        ("resonance", "", motion(SMALL + SHAKEN, modes=(31.0,))),
        ("oscillates", "mass × 0.8", motion(SMALL + SHAKEN, unstable_where=lambda: "mass × 0.8")),
        ("vibration", "", motion(SMALL + SHAKEN, unstable_where=lambda: "")),
    ],
    "a law that is unstable as described is said first, and one that may be is no other cause": [
        ("oscillates", "unstable", motion(0.55 * R, unstable_where=lambda: "as described")),
        ("oscillates", "unstable", motion(R, current=PUSHED, current_limit=0.9, unstable_where=lambda: "as described")),
        (
            "at_stop",
            "^(?!.*nobody described).*unstable",
            motion(R - 1.2e-3, stop=1.2e-3, unstable_where=lambda: "as described"),
        ),
        ("resonance", "", motion(R, modes=(80.0,), destabilised=lambda: True, unstable_where=lambda: "as described")),
        ("in_order", "", motion(unstable_where=lambda: "as described")),
        ("inaccurate", "", motion(0.55 * R, unstable_where=lambda: "mass × 0.8")),
    ],
    "an error is judged by what the description leaves, with the friction's range and the encoder's counts": [
        ("in_order", "", motion(8.0 * SMALL, promise=promised(0.31))),
        ("inaccurate", "leaves 0.29 µm.*allowed: 0.78 µm", motion(8.0 * SMALL, promise=promised(0.29))),
        ("in_order", "", motion(8.0 * SMALL, promise=promised(0.29), by_encoder=True)),
        ("in_order", "", motion(8.0 * SMALL, promise=promised(0.2), friction=3.0)),
        ("in_order", "", motion(8.0 * SMALL, promise=promised(0.2, largest=0.71))),
        ("in_order", "", motion(2.9 * SMALL, promise=promised(0.0))),
        ("inaccurate", "", motion(0.55 * R, promise=promised(100.0))),
    ],
    "an error that lasts is not hidden by a p-p that moments of the described strokes have": [
        ("in_order", "", motion(SLOW, promise=promised(1.0, rms=0.13))),
        ("inaccurate", "0.279 µm.*0.12 µm; allowed: 0.269 µm", motion(SLOW, promise=promised(1.0, rms=0.12))),
        ("in_order", "", stalled(SLOW, promise=promised(1.0, rms=0.12))),
        ("in_order", "", motion(SLOW, count=0.3e-6, promise=promised(1.0, rms=0.0))),
    ],
    "an error that the noise of the map asks for is the map's": [
        ("inaccurate", "noise of its survey.*stage.guide.smooth", motion(8.0 * SMALL, promise=promised(0.1, 0.7))),
        ("inaccurate", "^(?!.*noise)", motion(8.0 * SMALL, promise=promised(0.1, 0.3))),
    ],
    "an error that is too large goes with something": [
        ("inaccurate", "changes slowly", motion(SLOW, promise=promised(0.1))),
        *(
            ("inaccurate", "changes slowly", motion(0.5e-6 * sine(f), x=THERE_AND_BACK, promise=promised(0.1)))
            # Fewer than four waves in a stroke, from which what is around them cannot be told.
            for f in (0.9, 0.95)
        ),
        # A jog within some samples, in which no line has four waves.
        ("inaccurate", "changes slowly", motion(SLOW, x=QUICK_JOG, promise=promised(0.1))),
        # An encoder of x whose counts are many samples apart.
        ("inaccurate", "changes slowly", motion(SLOW, x=1e-5 * np.round(60.0 * TIME), promise=promised(0.1))),
        ("inaccurate", "encoder of y hardly shows it", motion(SLOW, promise=promised(0.1), unseen=True)),
        ("inaccurate", "zero of x is off by -1.5", motion(SLOW, promise=promised(0.1), unseen=True, zero=-0.0015)),
        ("inaccurate", "direction in which the platform moves", motion(DRAGGED, promise=promised(0.1))),
        ("inaccurate", "where the platform reverses", motion(AT_TURNS + NOISE, promise=promised(0.05))),
        ("inaccurate", "place of x.*learning.learn", motion(OF_PLACE, x=THERE_AND_BACK, promise=promised(0.05))),
        ("inaccurate", "place of x.*learning.learn", motion(TURNED, x=AND_A_JOG, promise=promised(0.05))),
        ("inaccurate", "comes in jumps.*bristle_stiffness", motion(STEPS + NOISE, promise=promised(0.05))),
    ],
    "a run in order that leaves twice what was promised says what that goes with": [
        ("in_order", "the described stage leaves 0.2 µm: it changes slowly", motion(0.7 * SLOW, promise=promised(0.2))),
        ("in_order", "^(?!.*described stage)", motion(0.7 * SLOW, promise=promised(0.29))),
        ("in_order", "^(?!.*described stage)", motion(0.7 * SLOW, promise=promised(0.2, largest=0.6))),
        ("in_order", "^(?!.*described stage)", motion(1.2 * NOISE, promise=promised(0.2))),
    ],
    "a sensor's own noise is no error of the map": [
        ("in_order", "", motion(fit=GuideFit(20e-6, 0.3e-6, "", 0.04e-6))),
        ("wrong_guide", "", motion(fit=GuideFit(20e-6, 0.3e-6, "", 0.02e-6))),
    ],
    "an error of the first moments is of a platform that had not settled, and a later one is not": [
        ("inaccurate", "0.1 µm after the first moments.*stage.motion.settle", motion(SMALL + bump(0.0, 13e-6))),
        ("inaccurate", "^(?!.*settle)", motion(SMALL + bump(1.0, 13e-6, 0.3))),
        ("inaccurate", "^(?!.*settle)", motion(0.55 * R + bump(0.0, 13e-6))),
    ],
    "friction that the balance of forces shows beyond its described range is named": [
        ("inaccurate", r"not as described: 2 N, allowed: 2 times 0\.4 N", motion(0.55 * R, **DRY, coulomb=0.4)),
        ("inaccurate", "^(?!.*allowed: 2 times)", motion(0.55 * R, **DRY, coulomb=1.1)),
        ("inaccurate", "^(?!.*allowed: 2 times)", motion(0.55 * R, **DRY)),
        # Of a stroke that is too short nothing is known: it hides nothing of the others.
        ("inaccurate", "not as described: 2 N", motion(0.55 * R, **DRY, coulomb=0.4, x=STROKE_AND_JOG)),
    ],
    "an error of half the uncompensated deviation is inaccurate": [
        ("in_order", "", motion(0.45 * R)),
        ("inaccurate", "", motion(0.55 * R)),
        ("inaccurate", "", motion(R)),
    ],
    "on a nearly straight guide the encoder's counts are no fault of the law": [
        ("in_order", "", motion(0.7 * NEARLY, NEARLY, fit=None)),
        ("inaccurate", "", motion(0.7 * NEARLY, NEARLY, fit=None, count=0.01e-6)),
        ("inaccurate", "", motion(1.3 * NEARLY, NEARLY, fit=None)),
    ],
    "an uncompensated run is in order and says so": [
        ("in_order", "uncompensated", motion(SMALL, 1e-9 * np.sin(TIME), fit=OTHER)),
        ("in_order", "uncompensated", motion(8.0 * SMALL, 0.0 * R, fit=OTHER, map_pp=20e-6)),
        ("in_order", "uncompensated", motion(8.0 * SMALL, 0.004 * R, fit=None, count=1e-9)),
        # To an encoder of nanometres it asks for much.
        ("inaccurate", "", motion(8.0 * SMALL, 0.004 * R, fit=None, count=1e-9, resolution=1e-9)),
    ],
    "a short motion on a gentle piece of a map is compensated, and is judged by its promise": [
        ("inaccurate", "", motion(8.0 * SMALL, GENTLE, promise=promised(0.29), **JOG)),
        ("in_order", "^(?!.*uncompensated)", motion(8.0 * SMALL, GENTLE, promise=promised(0.31), **JOG)),
        ("inaccurate", "", motion(8.0 * SMALL, GENTLE, **JOG)),
        # As on a whole stroke, a slow error is no oscillation, and what is little at rest does not hunt.
        ("inaccurate", "", motion(0.4e-6 * sine(5.0), GENTLE, promise=promised(0.29), **JOG)),
        ("in_order", "", motion(SHORT_STEPS, GENTLE, x=PAUSED, count=1e-9, promise=promised(0.31), **JOG)),
    ],
}


@pytest.mark.parametrize("truth", CASES)
def test_a_run_is_judged_by_its_own_fault_and_the_nearest_run_without_it_is_in_order(truth):
    for verdict, reason, run in CASES[truth]:
        found = verdict_of(run)
        assert found.verdict == verdict and found.in_order == (verdict == "in_order")
        assert re.search(reason, found.reason), found


def test_of_several_runs_that_with_the_largest_error_is_named_first_of_those_that_are_not_in_order():
    good, bad = Verdict("in_order", "error 1 µm"), Verdict("at_stop", "|y| is large")
    assert worst([(3.0, good), (2.0, bad), (1.0, good)], "start") == Verdict("at_stop", "start 2 of 3: |y| is large")
    assert worst([(1.0, bad), (2.0, bad), (1.0, bad)], "start").reason == "start 2 of 3: |y| is large"
    assert worst([(1.0, good), (2.0, good), (1.0, good)], "start") == Verdict("in_order", "start 2 of 3: error 1 µm")
    assert worst([(1.0, bad)], "start") == bad and worst([(1.0, good)], "start") == good


def test_a_verdict_reads_as_words():
    assert str(Verdict("left_map", "the stage moved")) == "left map: the stage moved"
    assert len(set(WORDS)) == len(WORDS) and all(one == one.lower() and " " not in one for one in WORDS)


def test_bounds_come_from_what_the_parameters_name_and_a_real_board_does_not_know_its_stop():
    def bounds_of(parameters):
        return {name: value for name, value in all_bounds(parameters).items() if not callable(value)}

    assert bounds_of({}) == {}
    named = {"driver": {"stage.platform.stop": 1e-3}, "controller": {"stage.actuator.current_limit": 0.5}}
    described = {
        "friction": 2.0,
        "sensor_noise": 0.5,
        "map_noise": 0.02e-6,
        "modes": (),
        "dither": 0.0,
        "resolution": 1e-7,
    }
    described |= {"coulomb": 0.43, "current_stiffness": StageParameters().actuator.current_stiffness}
    assert bounds_of(named) == {"stop": 1e-3, "current_limit": 0.5, **described}
    assert bounds_of({"driver": {}, "controller": {}}) == {"stop": 1.2e-3, "current_limit": 0.9, **described}
    weak = {"stage.drive.gain": 0.01, "stage.drive.dac_bits": 4}
    for parameters in ({"driver": weak, "controller": {}}, {"controller": weak}):
        assert bounds_of(parameters)["current_limit"] == pytest.approx(7 * 0.2 / 16)
    board = {"hardware": "can", "stage.platform.stop": 1e-3}
    assert bounds_of({"driver": board}) == {}
    assert bounds_of({"driver": {**board, "can.simulated_stage": True}})["stop"] == 1e-3
    stiff = {"stage.friction.bristle_stiffness": 1e9}
    assert bounds_of({"controller": stiff})["dither"] == pytest.approx(500.0)
    assert bounds_of({"controller": {**stiff, "control.law": "smc"}})["dither"] == 0.0


def test_the_count_of_the_encoder_is_the_smallest_step_of_its_readings():
    assert encoder_count(np.array([3.0, 1.0, 2.0, 1.0]) * 1e-7) == pytest.approx(1e-7)
    assert encoder_count(np.array([1e-7, 1e-7 + 1e-20])) == 0.0


def test_commands_that_came_later_than_described_are_those_of_the_rarest_hundredth_and_a_verdict_says_so():
    for longest, allowed in ((1.5, 0.3), (0.5, 0.2)):
        driver = {"stage.rate": 2000, "stage.drive.delay": 0.2, "stage.uncertainty.longest_delay": longest}
        assert late_commands(np.empty(0), driver) == ""
        for delay, late in ((allowed + 0.01, True), (allowed, False)):
            assert (late_commands(np.full(200, delay * T), driver) != "") == late
        # Of 2,000 commands the 20 that come latest may be late.
        for number, late in ((19, False), (22, True)):
            assert (late_commands(np.where(np.arange(2000) < number, 0.9, 0.1) * T, driver) != "") == late
    words = late_commands(np.where(np.arange(1000) < 300, 0.4, 0.14) * T, driver)
    assert "0.4 at p99" in words and "30% of them later" in words and "allow: 0.2;" in words
    for error, word in ((SMALL, "in_order"), (R, "inaccurate")):
        found = verdict_of(motion(error, late=words))
        assert found.verdict == word and found.reason.endswith(words)


def test_a_sensor_shows_the_guide_from_five_readings_on_at_each_of_200_places(make_record, cosine_map):
    record = make_record(truth=False)
    moving, sensor = record.motion.samples(), cosine_map.deviations(record.x)
    for readings, said in ((1000, True), (999, False), (0, False)):
        sensor[np.delete(moving, np.linspace(0, moving.size - 1, readings).astype(int))] = np.nan
        assert (judged_motion(record, cosine_map, {}, sensor=sensor).fit is not None) == said
    assert judged_motion(record, cosine_map, {}).fit is None
    # The guide is the map's: what is left is the sensor's noise.
    sensor[moving] = np.nan
    some = np.linspace(0, moving.size - 1, 1000).astype(int)
    sensor[moving[some]] = cosine_map.deviations(record.x[moving[some]]) + np.random.default_rng(1).normal(
        0.0, 1e-6, 1000
    )
    found = judged_motion(record, cosine_map, {}, sensor=sensor)
    assert 0.5 * found.largest_of_map < found.fit.left_pp < found.largest_of_map


def test_of_a_sensor_the_noise_is_that_of_its_means_and_a_guide_that_differs_by_direction_has_none(
    make_record, cosine_map
):
    record = make_record(truth=False)
    guide = cosine_map.deviations(record.x)
    backward = np.isin(np.arange(record.x.size), record.motion.samples("backward"))
    true = judged_motion(make_record(), cosine_map, {}).fit
    noise = np.random.default_rng(1).normal(0.0, 1e-6, record.x.size)
    # 200 means each way, of which each is of some sixty samples.
    of_mean = 1e-6 * np.sqrt(400.0 / record.motion.samples().size)
    for error, noise_left, left in (
        (0.0 * guide, 0.0, 0.0),
        (noise, of_mean, 6.0 * of_mean),
        (1e-6 * backward, 0.0, 1e-6),
    ):
        fit = judged_motion(record, cosine_map, {}, sensor=guide + error).fit
        assert fit.noise == pytest.approx(noise_left, rel=0.05, abs=3e-9)
        assert fit.left_pp == pytest.approx(left, rel=0.15, abs=0.03e-6)
        assert fit.guide_pp == pytest.approx(true.guide_pp, abs=left + 0.1e-6)
    assert (true.noise, true.left_pp) == pytest.approx((0.0, 0.0), abs=1e-12)
    # Backward at half the speed: the line lies between the ways, as it does where the truth is known.
    each = np.repeat(np.arange(record.x.size), np.where(backward, 2, 1))
    slow = replace(
        record, **{name: of[each] for name, of in record.columns().items()} | {"time": T * np.arange(each.size)}
    )
    fit = judged_motion(slow, cosine_map, {}, sensor=(guide + 1e-6 * backward * (record.x - record.x.mean()))[each]).fit
    assert fit.left_pp == pytest.approx(0.5e-6 * np.ptp(record.x), rel=0.02)


def test_a_run_is_judged_from_its_first_to_its_last_motion_by_its_truth_and_the_stalls_within(make_record, cosine_map):
    record = make_record(1e-6 * np.sin(np.arange(make_record().time.size)), quantum=1e-9)
    window, begin = record.motion.window, float(record.moving.time[0])
    end = float(record.moving.time[-1])
    stalls = [Stall(*of) for of in ((0.0, begin - T), (0.0, begin), (2.0, 2.1), (end, end + T), (end + T, end + 1.0))]
    late = np.full(100, 9.0 * T)
    found = judged_motion(record, cosine_map, {"driver": {}}, stalls=stalls, latency=late)
    assert found.stalls == tuple(stalls[1:4]) and found.late == late_commands(late, {}) != ""
    assert found.time == pytest.approx(record.time[window]) and found.y == pytest.approx(record.true_y[window])
    assert found.error == pytest.approx((record.r - record.true_y)[window], abs=2e-9) and not found.by_encoder
    assert found.count == pytest.approx(1e-9) and judged_motion(record, cosine_map, {}).late == ""
    # From the half of its RMS on the encoder shows an error.
    for part, unseen in ((0.4, True), (0.6, False)):
        seen = replace(record, y=record.r + part * (record.y - record.r))
        assert judged_motion(seen, cosine_map, {}).unseen == unseen
    shifted = replace(record, true_x=record.true_x + 0.002)
    assert judged_motion(shifted, cosine_map, {}).zero - found.zero == pytest.approx(0.002)
    blind = judged_motion(make_record(truth=False), cosine_map, {})
    assert blind.by_encoder and not blind.unseen and blind.error == pytest.approx(blind.r - blind.y)


def test_what_a_run_is_allowed_grows_with_its_description_in_closed_form():
    def allowed(error, smooth=(0.2, 0.1), drawn=(0.0, 0.0), **changes):
        asked = []
        left = [Left(pp * 1e-6, rms * 1e-6) for pp, rms in (smooth, drawn)]
        run = motion(
            error,
            promise=lambda: Promise(left[0], lambda at: (asked.append(at), left[1])[1], lambda: left[0]),
            **changes,
        )
        return run.largest * 1e6, run.largest_rms * 1e6, asked

    count = 1.0 / np.sqrt(12.0)
    for by, (pp, rms) in ((False, (0.1, 0.1 * count)), (True, (0.3, 0.2 * count + 0.05))):
        # Friction up to twice as large, the counts of what is seen, and the noise of the encoder both ways.
        found = allowed(8.0 * SMALL, by_encoder=by)
        assert found[:2] == pytest.approx((0.4 + (0.3 if by else 0.2), 0.2 + rms))
        # What more strokes of the description leave is asked for by what is more than the encoder's.
        if found[2]:
            assert found[2][0] == pytest.approx((0.8e-6 - pp * 1e-6, (8.0 * SMALL).std() - rms * 1e-6))
        drawn = allowed(8.0 * SMALL, drawn=(3.0, 2.0), by_encoder=by)
        assert drawn[:2] == pytest.approx((3.0 + pp, 2.0 + rms)) and len(drawn[2]) == 1
    assert allowed(8.0 * SMALL, friction=3.0)[0] == pytest.approx(0.8)
    assert allowed(8.0 * SMALL, sensor_noise=1.0, friction=1.0)[0] == pytest.approx(0.5)
    # Never more than half of the whole guide, nor less than three counts.
    assert allowed(8.0 * SMALL, (90.0, 50.0), map_pp=30e-6)[0] == pytest.approx(15.0)
    assert allowed(8.0 * SMALL, (0.001, 0.0), sensor_noise=0.0)[0] == pytest.approx(0.3)
    assert np.isinf(allowed(8.0 * SMALL, stalls=(Stall(4.0, 4.1),))[1])
    for known, fit, largest in ((0.02e-6, 0.0, 0.2), (0.03e-6, 0.04e-6, 0.4)):
        assert motion(map_noise=known, fit=GuideFit(1.0, 1.0, "", fit)).largest_of_map * 1e6 == pytest.approx(largest)


def test_a_disturbance_reaches_into_the_time_of_recovery_and_a_rest_begins_200_ms_after_its_stroke():
    run = motion(x=PAUSED)
    # 100 ms, or 200 samples.
    for rate, samples in ((2000.0, 200), (10_000.0, 1000), (500.0, 200)):
        quick = replace(run, time=np.arange(TIME.size) / rate)
        (disturbed,) = runs_of(quick.disturbed([Stall(100.0 / rate, 109.5 / rate)]))
        assert disturbed.tolist() == [100, 110 + samples]
    assert not run.disturbed([]).any()
    (rest,) = run.resting()
    assert rest.size == pytest.approx(1.8 / T, abs=5) and rest == pytest.approx(
        run.error[10_000 - rest.size : 10_000], abs=1e-9
    )
    # Half of the way is enough to judge by.
    for gone, enough in ((0.49, True), (0.51, False)):
        assert motion().judgeable(gone * 8.0 > TIME) == enough
    mask = TIME < 1.0
    assert (
        motion(SMALL + bump(0.5, 2e-6)).calm(mask) == pytest.approx(0.1e-6)
        and motion().calm(mask | ~mask) == motion().pp
    )


def test_modes_take_margins_where_they_ring_at_the_crossing_and_none_where_there_are_none():
    mode = "stage.platform.modes.first"
    ringing = {f"{mode}.frequency": 60.0, f"{mode}.damping": 0.002}
    assert destabilised(ringing) and not destabilised({}) and not destabilised({"control.law": "of another version"})
    bounds = all_bounds({"controller": ringing})
    assert bounds["modes"] == (60.0,) and bounds["destabilised"]()


def test_the_span_of_a_map_is_its_survey_and_the_run_out_on_both_sides(cosine_map):
    first, last = cosine_map.span
    for parameters, runout in (
        ({"feedforward": {"stage.guide.runout": 0.03}}, 0.03),
        ({}, StageParameters().guide.runout),
    ):
        bounds = all_bounds(parameters, cosine_map)
        assert bounds["span"] == pytest.approx((first - runout, last + runout))
        assert bounds["map_pp"] == pytest.approx(20e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("disturbances", "stroke", "verdict", "words"),
    [
        # On strokes that hardly cruise.
        ({"cogging.pitch": 0.016, "cogging.force": 0.8}, 0.6, "locked_to_x", "every 16 mm"),
        ({"cogging.pitch": 0.01, "cogging.force": 0.8}, 0.45, "locked_to_x", "every 10 mm"),
        ({"cable.drag": 4.0}, 0.3, "inaccurate", "^(?!.*friction).*cable or hose"),
        ({"drift.current": 0.05}, 0.3, "inaccurate", "^(?!.*cable or hose)"),
    ],
)
def test_what_disturbs_a_simulated_machine_is_named(verb, disturbances, stroke, verdict, words):
    changes = {f"driver.simulated.truth.disturbances.{name}": value for name, value in disturbances.items()}
    changes["stage.motion.stroke"] = stroke
    found = verb("simulate", "--json", *(f"--set={name}={value}" for name, value in changes.items())).json
    assert found["verdict"] == verdict and re.search(words, found["reason"])
