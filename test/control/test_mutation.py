"""Each sign in a law's step matters: with any one turned over the closed loop errs more than with the law as it is."""

import ast
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from straightcomp_ros.control import sliding_mode, smc_observer
from straightcomp_ros.control.filters import FilterParameters, HumParameters, NotchParameters
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.model.plant import advance
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
_FREE = replace(STAGE, friction=replace(STAGE.friction, coulomb=0.0, static=0.0))
FLEXURE = replace(_FREE, platform=replace(STAGE.platform, stiffness=5e4, damping=20.0))
"""What a stage without friction is described as, whose flexure is a tenth stiffer."""
PERIOD_NS, SAMPLES, SETTLED = 500_000, 600, 200
ENCODER = 1e-7
FILTERS = FilterParameters(first=NotchParameters(400.0, 0.3), mains=HumParameters(50.0, width=20.0))
LIMIT = STAGE.actuator.current_limit
AMPLITUDE, ANGULAR = 10e-6, 2.0 * math.pi * 2.0
ALLOWED = 1.02
"""A law is rejected when its error is more than so many times that of the law as it is; all is deterministic."""


def closed_loop_error(law, plant):
    """RMS of r − y in m on the simulated plant, following 10 µm at 2 Hz through friction, encoder and delay.

    Infinite for a law that fails, or that reports an error or a switching part that are not those of its answer.
    """
    constants, state = plant.constants(), np.zeros(7)
    command, square = 0.0, 0.0
    for index in range(SAMPLES):
        angle = ANGULAR * index * PERIOD_NS * 1e-9
        r, r_dot = AMPLITUDE * math.sin(angle), AMPLITUDE * ANGULAR * math.cos(angle)
        if index >= SETTLED:
            square += (r - state[0]) ** 2
        reading = ENCODER * round(state[0] / ENCODER)
        try:
            answer = law.step(reading, r, r_dot, -ANGULAR * ANGULAR * r, float(state[3]))
        except (ArithmeticError, ValueError):
            return math.inf
        current = answer.current
        asked = answer.equivalent_current + answer.switching_current
        limited = abs(current) >= 0.999 * LIMIT
        if answer.error != r - reading or not (limited or math.isclose(current, asked, abs_tol=1e-9)):
            return math.inf
        advance(constants, state, 1.0, command, PERIOD_NS // 2, current, PERIOD_NS // 2)
        command = current
    return math.sqrt(square / (SAMPLES - SETTLED))


def sign_mutants(module):
    """The place of each + and − in the module's ``step``, and ``step`` with that one turned over."""
    lines = Path(str(module.__file__)).read_text(encoding="utf-8")
    for number in range(len(_signs(_step_in(lines)))):
        function = _step_in(lines)
        sign = _signs(function)[number]
        sign.op = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.USub: ast.UAdd}[type(sign.op)]()
        function.decorator_list, function.returns = [], None
        for argument in function.args.args:
            argument.annotation = None
        namespace = dict(vars(module))
        exec(compile(ast.Module(body=[function], type_ignores=[]), str(module.__file__), "exec"), namespace)
        yield f"line {sign.lineno}: {ast.unparse(sign)}", namespace["step"]


def _step_in(source):
    return next(node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef) and node.name == "step")


def _signs(function):
    return [node for node in ast.walk(function) if isinstance(getattr(node, "op", None), ast.Add | ast.Sub | ast.USub)]


@pytest.mark.parametrize(("law", "module"), [("smc", sliding_mode), ("smc_observer", smc_observer)])
def test_the_closed_loop_rejects_nearly_every_sign_turned_over_in_the_source(law, module):
    """What may be left are signs that act only at the current's limit, which this motion does not reach."""
    parameters = ControlParameters(law=law)
    cases = [
        (parameters, STAGE, STAGE),
        (replace(parameters, filters=FILTERS), STAGE, STAGE),
        (parameters, FLEXURE, replace(FLEXURE, platform=replace(FLEXURE.platform, stiffness=5.5e4))),
    ]
    unseen: list[set[str]] = []
    for control, described, machine in cases:
        right = make_law(control, described)
        allowed = ALLOWED * closed_loop_error(right, machine.plant)
        errors = {
            place: closed_loop_error(Law(right.gains, right.start, step), machine.plant)
            for place, step in sign_mutants(module)
        }
        assert len(errors) >= 5 and math.isfinite(allowed)
        unseen.append({place for place, error in errors.items() if error <= allowed})
    assert len(set.intersection(*unseen)) <= 1, unseen
