"""A function that gives NaN or infinity along the guess is named, with its entry and its place."""

import re

import numpy as np
import pytest

from slipcar.planner import plan


class Cart:
    """x'' = u from rest at 0 to rest at 1 in two seconds, guessed as a straight line."""

    start, times, control_weight = np.zeros(2), np.linspace(0.0, 2.0, 41), np.eye(1)
    terminal_weight = np.full(2, 100.0)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], -1)

    def diffusion(self, t, x):
        return np.broadcast_to([[0.0], [0.1]], (*x.shape[:-1], 2, 1))

    def terminal(self, x):
        return x - np.array([1.0, 0.0])

    def initial_guess(self):
        x = np.linspace([0.0, 0.5], [1.0, 0.5], 41)
        x[0], x[-1] = [0.0, 0.0], [1.0, 0.0]
        return x, np.zeros((40, 1))


def hole(x):
    """Finite up to 0.56 m, which the guess passes between nodes 22 and 23; NaN beyond."""
    return np.log(0.56 - x[..., 0])


def one_row(self, t, x):
    return hole(x)[..., None]


CASES = {
    "drift": (
        {"drift": lambda self, t, x, u: np.stack([x[..., 1], u[..., 0] + hole(x)], -1)},
        r"drift\[1\] = nan at node 23, t = 1\.15, x = \(0\.575, 0\.5\), u = \(0\)",
    ),
    "diffusion": (
        {"diffusion": lambda self, t, x: np.stack([0.0 * t, np.log(1.12 - t)], -1)[..., None]},
        r"diffusion\[1, 0\] = nan at node 23, t = 1\.15",
    ),
    "terminal": (
        {"terminal": lambda self, x: np.stack([x[..., 0] - 1.0, hole(x)], -1)},
        r"terminal\[1\] = nan at node 40, t = 2, x = \(1, 0\)",
    ),
    "penalty": (
        {"penalty": one_row, "penalty_weight": np.ones(1)},
        r"penalty\[0\] = nan at node 23",
    ),
    "state_cost": ({"state_cost": lambda self, t, x: hole(x)}, r"state_cost = nan at node 23"),
    "control_cost": ({"control_cost": one_row}, r"control_cost\[0\] = nan at node 23"),
}


@pytest.mark.parametrize("options", [{}, {"compiled": False}, {"method": "convex"}, {"starts": 2}])
@pytest.mark.parametrize("name", CASES)
def test_the_function_is_named(name, options):
    members, message = CASES[name]
    problem = type(f"Holed_{name}", (Cart,), members)()
    with pytest.raises(ValueError, match=f"^(guess 0: )?{name} is not finite along .*: {message}"):
        plan(problem, **options)


@pytest.mark.parametrize("penalised", [False, True])
def test_a_constraint_that_has_a_price_is_named_as_what_it_is(penalised):
    members = {"constraint": one_row}
    if penalised:
        members |= {"penalty": lambda self, t, x: x[..., :1] - 9.0, "penalty_weight": np.ones(1)}
    problem = type("Priced", (Cart,), members)()
    assert plan(problem).status.ok  # nobody asks for it
    message = r"constraint is not finite along the guess: constraint\[0\] = nan at node"
    with pytest.raises(ValueError, match=message):
        plan(problem, risk_price=1.0)


def test_derivatives_alone_may_be_infinite():
    """√ at zero has a value and no slope; a sum may overflow that no function is to blame for."""
    root = type("Root", (Cart,), {"state_cost": lambda self, t, x: np.sqrt(x[..., 0])})
    rest = np.maximum(np.linspace([-0.2, 0.5], [1.0, 0.5], 41), 0.0), np.zeros((40, 1))
    message = r"the derivative of state_cost is not finite .*it\[0\] = inf at node 1, t = 0.05"
    with pytest.raises(ValueError, match=message):
        plan(root(), method="convex", guess=rest, cold_start="never")
    huge = type(
        "Huge",
        (Cart,),
        {"penalty": lambda self, t, x: 1e200 + x[..., :1], "penalty_weight": np.ones(1)},
    )
    with pytest.raises(ValueError, match="the cost is not finite along the guess, though every"):
        plan(huge())


def test_steps_between_nodes_are_looked_at():
    """Runge–Kutta's midpoints lie beyond what the nodes see."""

    def drift(self, t, x, u):
        gap = np.where(np.abs(x[..., 1] - 0.75) < 0.1, np.nan, 0.0)
        return np.stack([x[..., 1] + gap, u[..., 0] + 20.0 + 0.0 * t], -1)

    guess = np.tile([0.0, 0.25], (41, 1)), np.zeros((40, 1))
    problem = type("Between", (Cart,), {"drift": drift, "start": np.array([0.0, 0.25])})()
    message = re.escape("drift is not finite along the guess: its step to the next node[0] = nan")
    with pytest.raises(ValueError, match=message):
        plan(problem, guess=guess, integrator="rk4", method="convex", cold_start="never")
