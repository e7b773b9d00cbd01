"""Worlds and options at the edge: no exception, no warning, and no false claim."""

import warnings

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.convex.units import natural_units, scaled
from slipcar.planner.problem.model import model_of

PAPER = Scenario.named("paper")
OPEN = Scenario.named("open")


def crowded(count):
    rng = np.random.default_rng(0)
    rows = []
    while len(rows) < count:
        centre, radius = rng.uniform(-1.0, 5.0, size=2), rng.uniform(0.1, 0.4)
        if min(np.hypot(*centre), np.hypot(*(centre - 4.0))) > radius + 0.2:
            rows.append((*centre, radius))
    return OPEN.replace(goal=(4.0, 4.0, 0.0, 0.0, 0.0), obstacles=rows, horizon=8.0)


ring = [(np.cos(a), np.sin(a), 0.3) for a in 2.0 * np.pi * np.arange(11) / 11]
wall = [(1.5, y, 0.4) for y in np.linspace(-1.0, 1.2, 9)]
AHEAD = (3.0, 0.0, 0.0, 0.0, 0.0)

#: name -> (scenario, options of `plan`, statuses allowed)
GOOD = {Status.CONVERGED}
ANY = set(Status) - {Status.SOLVER_FAILED, Status.STOPPED}
CASES = {
    "two nodes": (PAPER.replace(nodes=2), {}, {Status.INFEASIBLE}),
    "three nodes": (PAPER.replace(nodes=3), {}, {Status.INFEASIBLE}),
    "four nodes": (PAPER.replace(nodes=4), {}, GOOD),
    "six hundred nodes": (PAPER.replace(nodes=601), {}, GOOD),
    "a tenth of a second": (PAPER.replace(horizon=0.1), {}, {Status.INFEASIBLE}),
    "too short by a third": (PAPER.replace(horizon=1.8), {}, {Status.INFEASIBLE}),
    "fifty seconds": (PAPER.replace(horizon=50.0), {}, GOOD),
    "eight minutes": (PAPER.replace(horizon=500.0), {}, GOOD),
    "in no time without bounds": (PAPER.replace(horizon=0.1, control_bounds=None), {}, ANY),
    "there already": (OPEN.replace(goal=OPEN.start), {}, GOOD),
    "there already, obstacles": (PAPER.replace(goal=PAPER.start), {}, GOOD),
    "turn on the spot": (OPEN.replace(goal=(0.0, 0.0, 3.0, 0.0, 0.0)), {}, GOOD),
    "backwards": (OPEN.replace(goal=(-2.0, 0.0, 0.0, 0.0, 0.0)), {}, GOOD),
    "sideways": (OPEN.replace(goal=(0.0, 2.0, 0.0, 0.0, 0.0)), {}, GOOD),
    "rolling start": (PAPER.replace(start=(0.0, 0.0, 0.0, 1.5, 2.0)), {}, GOOD),
    "rolling backwards": (PAPER.replace(start=(0.0, 0.0, 0.0, -1.5, 0.0)), {}, GOOD),
    "rolling goal": (PAPER.replace(goal=(2.2, 3.0, 0.0, 1.0, 0.0)), {}, GOOD),
    "no slip": (PAPER.replace(slip=(0.0, 0.0)), {}, GOOD),
    "ice": (PAPER.replace(slip=(10.0, 3.0)), {}, ANY),
    "no obstacle weight": (PAPER.replace(obstacle_weight=0.0), {}, GOOD),
    "obstacle weight 1e6": (PAPER.replace(obstacle_weight=1e6), {}, GOOD),
    "variance weight 1e4": (PAPER, {"variance_weight": 1e4}, GOOD),
    "variance weight 1e-12": (PAPER, {"variance_weight": 1e-12}, GOOD),
    "unbounded": (PAPER.replace(control_bounds=None), {}, GOOD),
    "hardly bounded": (PAPER.replace(control_bounds=(1e6, 1e6)), {}, GOOD),
    "tight": (PAPER.replace(control_bounds=(0.65, 1.2)), {}, GOOD),
    "too tight": (PAPER.replace(control_bounds=(0.5, 0.8)), {}, {Status.INFEASIBLE}),
    "hopeless": (PAPER.replace(control_bounds=(1e-3, 1e-3)), {}, {Status.INFEASIBLE}),
    "head-on": (OPEN.replace(goal=AHEAD, obstacles=[(1.5, 0.0, 0.4)]), {}, GOOD),
    "head-on twice": (OPEN.replace(goal=AHEAD, obstacles=[(1.5, 0.0, 0.4)] * 2), {}, GOOD),
    "a wall of overlapping discs": (OPEN.replace(goal=AHEAD, obstacles=wall), {}, GOOD),
    "surrounded": (OPEN.replace(obstacles=ring), {}, GOOD),
    "thirty obstacles": (crowded(30), {}, GOOD),
    "a kilometre off": (OPEN.replace(goal=(1e3, 1e3, 0.0, 0.0, 0.0)), {"max_iterations": 20}, ANY),
    "far from the origin": (
        OPEN.replace(
            start=OPEN.start + np.array([1e6, 1e6, 0, 0, 0]),
            goal=OPEN.goal + np.array([1e6, 1e6, 0, 0, 0]),
        ),
        {},
        GOOD,
    ),
    "a box of ten metres": (PAPER, {"terminal_tolerance": 10.0}, GOOD),
    "literal, no trust region": (PAPER, {"linearization": "literal", "trust_region": "none"}, ANY),
    "a tolerance below rounding": (PAPER, {"tolerance": 1e-30}, ANY),
    "a guess of noise": (
        PAPER,
        {
            "guess": (
                2.0 * np.random.default_rng(1).normal(size=(41, 5)),
                3.0 * np.random.default_rng(2).normal(size=(40, 2)),
            )
        },
        ANY,
    ),
    "a guess at rest": (PAPER, {"guess": (np.zeros((41, 5)), np.zeros((40, 2)))}, GOOD),
}


def check(p, rollout, tolerance=0.0):
    """Whatever the status: finite, within bounds; and if converged, true."""
    scenario = p.problem
    for array in (p.mean, p.controls, p.covariance, p.effort, p.obstacle_cost, p.variance):
        assert np.isfinite(array).all()
    if scenario.control_bounds is not None:
        assert np.all(np.abs(p.controls) <= scenario.control_bounds * (1.0 + 1e-9))
    if p.status is Status.CONVERGED:
        size = 1.0 + np.max(np.abs(p.mean))
        assert np.max(np.abs(rollout(scenario, p.controls) - p.mean)) < 1e-3 * size
        assert np.max(np.abs(p.mean[-1] - scenario.goal)) < tolerance + 1e-6 * size


@pytest.mark.parametrize("name", CASES)
def test_edge_cases(name, rollout):
    scenario, options, allowed = CASES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        p = plan(scenario, **options)
    assert p.status in allowed
    check(p, rollout, options.get("terminal_tolerance", 0.0))


def test_infeasible_is_said_only_when_something_is_missing(rollout):
    for name, (scenario, options, allowed) in CASES.items():
        if allowed == {Status.INFEASIBLE}:
            p = plan(scenario, **options)
            missing = rollout(scenario, p.controls)[-1] - scenario.goal
            assert np.max(np.abs(missing)) > 1e-2, name


def test_turned_worlds(rollout):
    plans = [plan(Scenario.random(seed, turned=True), tolerance=1e-6) for seed in range(60)]
    for p in plans:
        check(p, rollout)
    assert np.mean([p.status.ok for p in plans]) >= 0.97


@pytest.mark.parametrize("seed", range(40))
def test_worlds_with_everything_drawn_at_random(seed, rollout):
    rng = np.random.default_rng(seed)
    base = Scenario.random(seed, turned=bool(rng.integers(2)))
    scenario = base.replace(
        horizon=10.0 ** rng.uniform(0.3, 1.2),
        nodes=int(rng.choice([2, 3, 4, 6, 11, 21, 41])),
        control_bounds=[None, (2.0, 4.0), (0.5, 1.0), (0.2, 0.5)][rng.integers(4)],
        slip=[(0.1, 0.01), (0.0, 0.0), (1.0, 0.3)][rng.integers(3)],
        obstacle_weight=10.0 ** rng.uniform(0.0, 6.0),
        start=base.start + np.array([0.0, 0.0, 0.0, *rng.normal(size=2)]),
    )
    tolerance = float(rng.choice([0.0, 0.0, 1e-3, 0.1]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        p = plan(
            scenario,
            variance_weight=float(rng.choice([0.0, 1.0, 10.0, 1000.0])),
            terminal_tolerance=tolerance,
            max_iterations=40,
        )
    assert p.status is not Status.SOLVER_FAILED
    check(p, rollout, tolerance)


class Idle:
    """dx = (0.7 x + 0.2) dt, whatever the controls, with ∫ uᵀRu + ℓ(x)ᵀu: u = −R⁻¹ℓ/2."""

    start, times = np.array([0.3]), np.linspace(0.0, 1.0, 9)
    control_weight = np.diag([1.37, 0.83])

    def drift(self, t, x, u):
        return 0.7 * x + 0.2 + 0.0 * u[..., :1]

    def diffusion(self, t, x):
        return np.zeros((*x.shape[:-1], 1, 1))

    def terminal(self, x):
        return 0.0 * x

    def control_cost(self, t, x):
        return np.concatenate([np.sin(3.0 * x), -0.6 * np.cos(x)], axis=-1)


@pytest.mark.parametrize("radius", [None, 1.0])
def test_controls_that_move_nothing_are_where_their_own_cost_is_least(radius):
    problem = Idle()
    if radius is not None:
        problem.control_radius = radius
    p = plan(problem)
    assert p.status is Status.CONVERGED
    least = -0.5 * problem.control_cost(p.times[:-1], p.mean[:-1]) / np.diag(Idle.control_weight)
    np.testing.assert_allclose(p.controls, least, atol=1e-9)
    assert p.certificate.extremal, str(p.certificate)


@pytest.mark.parametrize("size", [1.0, 1e-80, 1e-180])
def test_units_of_controls_that_do_nothing_are_finite(size):
    model = model_of(Idle())
    x, u = np.tile(Idle.start, (9, 1)), np.full((8, 2), size)
    units = natural_units(model, x, u, box=False)
    R = scaled(model, units).R
    assert np.isfinite(R).all()
    assert np.linalg.matrix_rank(R) == 2
