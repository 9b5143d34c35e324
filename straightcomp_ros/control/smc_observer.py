"""Law `smc_observer`: sliding mode with an observer, friction inside both, and a constant command at rest.

What limits a law without a friction model is local instability: while the platform slides near the Stribeck velocity,
friction falls with speed and acts like a negative stiffness, ten times that of the magnets. Here observer and law know
the friction F̂ of the LuGre model (Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 40(3), 1995;
`model/friction.py`), driven by a velocity that is mostly the reference's,

    v = ṙ + m (v̂ − ṙ),   ż = v − σ0 |v| z / g(v),

with a share m of the observer's v̂. m = 1 would feed the encoder's noise through the steep slope of friction at v = 0,
m = 0 would not notice when the platform sticks. The observer (`observer.py`) estimates d, the rest of the disturbance:

    M v̇ = f_c(y, i) + M d − F̂(z, v).

The sliding variable σ = (ẏ − ṙ) + λ (y − r) is that of the moment at which the command acts. It decays with the rate κ:

    a = r̈ − λ (ẏ − ṙ) − κ σ − d + F̂/M.

The size s of F̂ multiplies F_C and F_S, and is fitted while the law runs, by recursive least squares with forgetting. It
starts low: too much friction makes limit cycles of micrometres, too little is harmless. When s changes, d gives what F̂
takes. The disturbance that the observer estimates, d in m/s², is fitted by

    d = c + b r + s F̄

with the reference r and F̄ = −F̂/(s M). The observer's estimate lags: with the poles p, p and q it follows an
acceleration u, which acts from one sample to the next, by

    (1 − p)² (1 − q) z (z + 1) / (2 (z − p)² (z − q)) u,

and F̄ passes the same lag before it is compared. c takes what is constant, b an error of the magnets' stiffness; without
them both would be taken for friction. Normal equations and forgetting as in Åström and Wittenmark, Adaptive Control,
2nd ed. 1995, ch. 2. Forgetting lets the covariance P grow where nothing excites a direction: nothing is forgotten while
the trace of P would exceed `_LARGEST_TRACE`, and the fit is paused while the reference rests.

Where the model explains the friction, a slow observer and little gain leave the least error, and the coils are quiet.
Where it does not, the loop itself has to follow friction. The RMS of what the fit leaves unexplained moves the
observer's bandwidth, λ and κ between two sets, the quiet one and one that is stiffer by a factor.

Under dither friction is, in the mean over a turn, a curve that rises with the velocity. It takes the place of the
bristles, F̂ = s (F_C/√(v² + v_d²) + σ2) v, with the velocity v_d that the dither would give the mass without friction.
Its amplitude follows the friction that is found. It begins and ends over some turns: one that began at once would push
the platform, which has been held, by a count.

At rest the quantised reading would keep the command moving. Once the reading has stayed within a band around a resting
reference for a while, the command is held at the mean of the last ones. When the hold ends, the mean difference between
held and computed command decays slowly, so that leaving rest makes no bump.

Tuning: first `gain_allowance`, the assumed acceleration per current relative to nominal. More of it lowers the loop's
gain: machines with strong magnets, little mass or late commands stay stable; too much, and a weak machine does not hold
against the negative stiffness (`margins.py` gives both limits). Then the observer's bandwidth, λ and κ together. With
T_d = 1.5 T + 1/(2π f_amp): bandwidth 0.219/T_d in Hz, λ = 0.614/T_d, κ = 0.423/T_d.
"""

import math
from typing import NamedTuple

from straightcomp_ros.control.filters import EMPTY, Filters, Memory, filtered
from straightcomp_ros.control.law import Command
from straightcomp_ros.control.observer import (
    Estimate,
    Loop,
    ObserverGains,
    corrected,
    current_for,
    limited,
    moment_of_action,
    predicted,
    with_mass,
    with_measured_current,
)
from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.converters import nearest_step
from straightcomp_ros.model.friction import LuGre, bristle_after, friction_force

_FIRST_VARIANCE = 1.0
"""Of c, b times the travel, and s, in units of the variance of one sample's disturbance."""
_LARGEST_TRACE = 30.0
_SETTLED = 0.1
"""Variance of s below which the fit is believed again after a motion has begun: what it finds in the first tenths of a
second may be no friction on a machine that has it. More than before is believed at once."""
UNDER_DITHER = 2.0 / math.pi
"""Size that Coulomb friction has under dither: the mean of its sign over a sine of velocity V is 2/π v/V."""
SMALLEST_SHAPE = 0.1
"""Size of friction below which the model keeps its shape and only its force shrinks: with the level the bristles' bend
would shrink to nothing, and the model to a switch that the encoder's noise throws."""

_PATIENCE = 5.0
"""Times the wait at rest after which the band grows in which a platform may toggle."""
_DOUBTING = 7.0
"""Times the wait at rest after which friction is doubted, unless the platform stands beside the reference for one."""
_STANDING = 15.0
"""Times the motion of a reference at rest: a platform that stands between two counts toggles by one. What has no
friction leaves a count within some 50 ms, or swings by more."""
_TOGGLING = 20.0
"""Times the band at rest: noise and stiction move a platform by counts. What moves one with friction farther is a push,
after which the hold is as narrow as before."""


class Lags(NamedTuple):
    """The last F̄ and the one before, and their mean behind one, two and three lags, m/s²."""

    last: float
    before: float
    first: float
    second: float
    third: float


class Fit(NamedTuple):
    """c in m/s², b times the travel in m/s², s, the upper triangle of P, the misfit, and the lags of F̄.

    The misfit is what c + b r + s F̄ leaves of d, smoothed, m/s², and the mean of its square.
    """

    constant: float
    slope: float
    size: float
    p00: float
    p01: float
    p02: float
    p11: float
    p12: float
    p22: float
    misfit: float
    misfit_square: float
    lags: Lags


class Stiffness(NamedTuple):
    """λ and κ in 1/s, the observer's gains (`ObserverGains`), the weights of a new value in the lags of its double pole
    and of its third pole, and the assumed mass in kg."""

    surface: float
    reaching: float
    position: float
    velocity: float
    disturbance: float
    double: float
    third: float
    mass: float


class Dither(NamedTuple):
    """Cosine and sine of the dither's angle, and the share of its amplitude that it has by now."""

    cosine: float
    sine: float
    level: float


class Gains(NamedTuple):
    """Constants of the law.

    Attributes:
        free, quiet, stiff: the law without friction, with friction that the model explains, and at its stiffest, from
            twice ``misfit`` on; ``slow``: quiet with the observer of free, midway.
        share: m.
        misfit: m/s², from which the law stiffens.
        kept: weight that the past of the fit keeps from one sample to the next.
        smooth, mean: weights of a new value in the smoothed misfit, and in its mean square.
        travel: m, by which r is scaled in the fit.
        smallest, largest: bounds of s.
        counting: s from which friction counts: below it the law goes over to ``free``.
        holding: s from which friction holds the platform where it rests.
        speed: largest |ṙ| in m/s of a reference at rest, at which the fit is paused.
        still: m, by which it may move there.
        band: largest |y − r| of the reading at rest, m.
        wait: time at rest until the command is held, s.
        weight: of the newest command in the mean that is held, and of the present in what the hold leaves behind.
        dither: its amplitude in A with friction as described.
        turn: cosine and sine of the angle by which it goes on in a period, and by how much its level then changes.
        knee: m/s, beside which friction saturates under that dither; 0 without dither.
        code, half_codes: A, and how many of them to either side: what the D/A converter can give.
    """

    free: Stiffness
    slow: Stiffness
    quiet: Stiffness
    stiff: Stiffness
    share: float
    misfit: float
    lugre: LuGre
    kept: float
    smooth: float
    mean: float
    travel: float
    smallest: float
    largest: float
    counting: float
    holding: float
    speed: float
    still: float
    band: float
    wait: float
    weight: float
    dither: float
    turn: Dither
    knee: float
    code: float
    half_codes: int
    loop: Loop
    filters: Filters


class Rest(NamedTuple):
    """Where the reference came to rest in m, time within the band in s, mean command in A, what is added to the
    computed command in A, and for how much longer than held it was free since the reference came to rest, s; about
    which place in m the platform has stood since then, and for how long, s."""

    place: float
    time: float
    mean: float
    offset: float
    restless: float
    stand: float
    stood: float


class State(NamedTuple):
    """The next sample as predicted with friction but for d, the command in A, z in m, the fit and the least s of it
    that is believed, rest, dither and filters."""

    prior: Estimate
    command: float
    bristle: float
    fit: Fit
    believed: float
    rest: Rest
    dither: Dither
    memory: Memory


def fit_at_start(size: float) -> Fit:
    """The fit before the first sample."""
    p = _FIRST_VARIANCE
    return Fit(0.0, 0.0, size, p, 0.0, 0.0, p, 0.0, p, 0.0, 0.0, Lags(0.0, 0.0, 0.0, 0.0, 0.0))


def start(size: float, y: float) -> State:
    """State at rest at ``y`` in m, with ``size`` of friction."""
    prior, rest = Estimate(y, 0.0, 0.0, 0.0), Rest(y, 0.0, 0.0, 0.0, 0.0, y, 0.0)
    return State(prior, 0.0, 0.0, fit_at_start(size), size, rest, Dither(1.0, 0.0, 0.0), EMPTY)


@compilable
def step(
    g: Gains, state: State, y: float, r: float, r_dot: float, r_ddot: float, current: float
) -> tuple[State, Command]:
    """One sample; see the module."""
    kept = state.believed if _SETTLED < state.fit.p22 < _FIRST_VARIANCE else state.fit.size
    believed = max(kept, state.fit.size)
    s = _stiffness(g, believed, state.fit.misfit_square)
    gains, loop = ObserverGains(s.position, s.velocity, s.disturbance), with_mass(g.loop, s.mass)
    observed = corrected(gains, with_measured_current(loop, state.prior, current), y)
    knee = g.knee * _dithering(state.fit)
    bristle, unit = _unit_friction(g, s.mass, knee, state.fit.size, state.bristle, r_dot, observed.velocity)
    fit = _doubted(g, fitted(g, s, state.fit, r, r_dot, unit, observed.disturbance), state.rest)
    others = observed.disturbance - (fit.size - state.fit.size) * fit.lags.third
    now = Estimate(observed.y, observed.velocity, others + fit.size * unit, observed.current)
    action, error, rate_error = moment_of_action(loop, now, state.command, r, r_dot, r_ddot)
    sigma = rate_error + s.surface * error
    holding = r_ddot - s.surface * rate_error - action.disturbance
    equivalent = current_for(loop, action.y, holding)
    wanted = current_for(loop, action.y, holding - s.reaching * sigma)
    # While the command is held, the error is not answered.
    asked, memory = filtered(g.filters, state.memory, wanted, y - r if state.rest.time <= g.wait else 0.0)
    asked, rest = _held(g, state.rest, fit, asked, y, r, r_dot)
    asked, dither = _dithered(g, state.dither, rest, fit, asked)
    answer = limited(loop.current_limit, asked)
    if believed < g.counting:
        # The slow observer would follow a stiffness that is not as described too late: the fit knows it.
        others += fit.slope / g.travel * r_dot * g.loop.period
        # Nothing holds the platform against what the converter rounds off: the observer knows it before it shows. No
        # size at all is only in the linearisation of `margins.py`.
        if believed > 0.0 and math.isfinite(answer):
            rounded = limited(loop.current_limit, nearest_step(g.code, g.half_codes, answer))
            asked, answer = asked + (rounded - answer), rounded
    after = predicted(loop.actuator, loop.mass, loop.after_action, action, answer, loop.stiffness)
    prior = Estimate(after.y, after.velocity, others, after.current)
    command = Command(answer, r - y, sigma, equivalent, asked - equivalent, now.velocity, now.disturbance)
    return State(prior, answer, bristle, fit, kept, rest, dither, memory), command


@compilable
def _stiffness(g: Gains, size: float, misfit_square: float) -> Stiffness:
    """From free over quiet, by the ``size`` of friction, to stiff, by the misfit."""
    # No size at all is only in the linearisation of `margins.py`, which asks for free and quiet one by one.
    calm = max(0.0, min(1.0, 2.0 - 2.0 * size / g.counting)) if size > 0.0 else 0.0
    a = _calmed(g, calm) if calm > 0.0 else g.quiet
    # The misfit is an acceleration of the mass that is assumed.
    misfit = math.sqrt(max(0.0, misfit_square)) * (a.mass / g.loop.mass)
    share = max(0.0, min(1.0, misfit / g.misfit - 1.0))
    if share <= 0.0:
        return a
    # What is not explained is no friction where there is none, and nothing damps the stiffest loop there.
    stiff = share - calm
    return _mixed(g.quiet, g.stiff, stiff) if stiff >= 0.0 else _calmed(g, -stiff)


@compilable
def _calmed(g: Gains, calm: float) -> Stiffness:
    """From quiet to free: first the observer, then the law. Midway on the straight line the much damping of the one
    meets the fast observer of the other, and no margins are left though both ends have them."""
    return _between(g.quiet, g.slow, 2.0 * calm) if calm <= 0.5 else _between(g.slow, g.free, 2.0 * calm - 1.0)


@compilable
def _mixed(a: Stiffness, b: Stiffness, share: float) -> Stiffness:
    return Stiffness(
        a.surface + share * (b.surface - a.surface),
        a.reaching + share * (b.reaching - a.reaching),
        a.position + share * (b.position - a.position),
        a.velocity + share * (b.velocity - a.velocity),
        a.disturbance + share * (b.disturbance - a.disturbance),
        a.double + share * (b.double - a.double),
        a.third + share * (b.third - a.third),
        a.mass + share * (b.mass - a.mass),
    )


@compilable
def _between(a: Stiffness, b: Stiffness, share: float) -> Stiffness:
    """As `_mixed`, by factors: gains that stand in a product keep it."""
    return Stiffness(
        a.surface ** (1.0 - share) * b.surface**share,
        a.reaching ** (1.0 - share) * b.reaching**share,
        a.position ** (1.0 - share) * b.position**share,
        a.velocity ** (1.0 - share) * b.velocity**share,
        a.disturbance ** (1.0 - share) * b.disturbance**share,
        a.double ** (1.0 - share) * b.double**share,
        a.third ** (1.0 - share) * b.third**share,
        a.mass ** (1.0 - share) * b.mass**share,
    )


@compilable
def _unit_friction(
    g: Gains, mass: float, knee: float, size: float, bristle: float, r_dot: float, observed: float
) -> tuple[float, float]:
    """z in m after this sample's period, and F̄ of ``mass`` in m/s² until then; r_dot and the ``observed`` velocity in
    m/s, as is the knee."""
    if size <= 0.0:
        # Only in the linearisation of `margins.py`.
        return bristle, 0.0
    velocity = r_dot + g.share * (observed - r_dot)
    coulomb, static, stribeck_velocity, stiffness, damping, viscous = g.lugre
    if knee > 0.0:
        # What friction is in the mean over the dither.
        return bristle, -velocity * (coulomb / math.hypot(velocity, knee) + viscous) / mass
    shape = max(size, SMALLEST_SHAPE)
    lugre = LuGre(shape * coulomb, shape * static, stribeck_velocity, stiffness, damping, viscous)
    after = bristle_after(lugre, bristle, velocity, g.loop.period)
    return after, -friction_force(lugre, after, velocity) / (shape * mass)


@compilable
def lagged(g: Stiffness, lags: Lags, unit: float) -> Lags:
    """The lags at the next sample; ``unit`` is F̄ until then."""
    first = lags.first + g.double * (0.5 * (lags.last + lags.before) - lags.first)
    second = lags.second + g.double * (first - lags.second)
    return Lags(unit, lags.last, first, second, lags.third + g.third * (second - lags.third))


@compilable
def fitted(g: Gains, stiffness: Stiffness, fit: Fit, r: float, r_dot: float, unit: float, others: float) -> Fit:
    """The fit after one sample with the reference ``r`` and ``r_dot`` (m, m/s).

    ``unit`` is F̄ from this sample to the next, ``others`` the observer's disturbance without friction, both in m/s²;
    with s F̄ behind the lags the latter is d.
    """
    lags = lagged(stiffness, fit.lags, unit)
    if abs(r_dot) <= g.speed:
        return Fit(*fit[:11], lags)
    c, b, s, p00, p01, p02, p11, p12, p22 = fit[:9]
    x, f = r / g.travel, lags.third
    k0 = p00 + p01 * x + p02 * f
    k1 = p01 + p11 * x + p12 * f
    k2 = p02 + p12 * x + p22 * f
    spread = g.kept + k0 + k1 * x + k2 * f
    # s F̄ is on both sides of the equation.
    left = others - c - b * x
    miss = left / spread
    misfit = fit.misfit + g.smooth * (left - fit.misfit)
    square = fit.misfit_square + g.mean * (misfit * misfit - fit.misfit_square)
    p00, p01, p02 = p00 - k0 * k0 / spread, p01 - k0 * k1 / spread, p02 - k0 * k2 / spread
    p11, p12, p22 = p11 - k1 * k1 / spread, p12 - k1 * k2 / spread, p22 - k2 * k2 / spread
    grow = 1.0 / g.kept if p00 + p11 + p22 <= _LARGEST_TRACE * g.kept else 1.0
    s = max(g.smallest, min(g.largest, s + k2 * miss))
    p00, p01, p02, p11, p12, p22 = grow * p00, grow * p01, grow * p02, grow * p11, grow * p12, grow * p22
    return Fit(c + k0 * miss, b + k1 * miss, s, p00, p01, p02, p11, p12, p22, misfit, square, lags)


@compilable
def _doubted(g: Gains, fit: Fit, rest: Rest) -> Fit:
    """The fit, with less friction where the platform does not come to rest and no motion has shown friction yet.

    At rest the friction model answers to the encoder's noise: without friction in the machine it makes a limit cycle.
    A platform that has stood beside the reference is held by friction.
    """
    # Without a band nothing is ever at rest.
    if g.band <= 0.0 or rest.restless <= _DOUBTING * g.wait or rest.stood > g.wait or fit.p22 < _FIRST_VARIANCE:
        return fit
    size = max(g.smallest, (1.0 - g.weight) * fit.size)
    return Fit(fit.constant, fit.slope, size, *fit[3:])


@compilable
def _held(g: Gains, rest: Rest, fit: Fit, asked: float, y: float, r: float, r_dot: float) -> tuple[float, Rest]:
    """The command for the one that the law asks for, A, and the rest with this sample."""
    resting, miss = abs(r_dot) <= g.speed and abs(r - rest.place) <= g.still, abs(y - r)
    place = rest.place if resting else r
    # Stiction may let the platform toggle across the band for ever: the band grows until the toggling is within.
    band = g.band * (1.0 + max(0.0, rest.restless / g.wait - _PATIENCE))
    time = 0.0
    if resting and miss <= band and fit.size >= g.holding:
        # A platform that slipped as the command was held, or creeps, is not left there: the hold is made anew.
        beside = rest.time > g.wait and miss > 0.5 * band
        time = rest.time - g.loop.period if beside else min(rest.time + g.loop.period, 2.0 * g.wait)
        time = 0.0 if beside and time <= g.wait else time
    held = time > g.wait
    restless = rest.restless + g.loop.period
    if held:
        restless = max(0.0, rest.restless - g.loop.period) if miss <= g.band else rest.restless
    # Before a motion has shown friction it may be a limit cycle of the friction that is assumed.
    if not resting or (miss > _TOGGLING * g.band and fit.p22 < _FIRST_VARIANCE):
        restless = 0.0
    stands = rest.stood > g.wait or (miss > 0.5 * g.band and abs(y - rest.stand) <= _STANDING * g.still)
    stand, stood = (rest.stand, rest.stood + g.loop.period) if resting and stands else (y, 0.0)
    if held:
        # A single computed command is as noisy as the reading; its mean is what the hold has kept from the platform.
        offset = rest.offset + g.weight * (rest.mean - asked - rest.offset)
        return rest.mean, Rest(place, time, rest.mean, offset, restless, stand, stood)
    offset = (1.0 - g.weight) * rest.offset
    mean = rest.mean + g.weight * (limited(g.loop.current_limit, asked + offset) - rest.mean)
    return asked + offset, Rest(place, time, mean, offset, restless, stand, stood)


@compilable
def _dithering(fit: Fit) -> float:
    """How much dither friction needs, relative to the described one: by its size, as far as that is known."""
    unknown = min(1.0, fit.p22 / _FIRST_VARIANCE)
    return unknown + (1.0 - unknown) * max(fit.size, SMALLEST_SHAPE) / UNDER_DITHER


@compilable
def _dithered(g: Gains, dither: Dither, rest: Rest, fit: Fit, asked: float) -> tuple[float, Dither]:
    """The command with dither, A, which ends while it is held, and the dither of the next sample."""
    if g.dither == 0.0:
        return asked, dither
    c, s = g.turn.cosine, g.turn.sine
    level = max(0.0, min(1.0, dither.level + (g.turn.level if rest.time <= g.wait else -g.turn.level)))
    after = Dither(c * dither.cosine - s * dither.sine, s * dither.cosine + c * dither.sine, level)
    return asked + level * _dithering(fit) * g.dither * dither.cosine, after
