"""The paper's case with its reference, and tools that know the dynamics but not the planner."""

import dataclasses
import json
import types
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import plan
from slipcar.planner.newton.posing import pose
from slipcar.planner.newton.running import solve_noise
from slipcar.planner.problem.model import model_of
from slipcar.planner.search.steering import Request


@pytest.fixture(scope="session")
def reference():
    path = Path(__file__).parents[1] / "data" / "paper_case.json"
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def paper():
    return Scenario.named("paper")


@pytest.fixture(scope="session")
def exact_paper_plan(paper):
    """Deterministic SCP on the paper's case to the last digit."""
    return plan(paper, variance_weight=0.0, tolerance=1e-16)


def _rollout(problem, controls):
    t, x = problem.times, np.array(problem.start, dtype=float)
    path = [x]
    for k, u in enumerate(controls):
        x = x + (t[k + 1] - t[k]) * problem.drift(t[k], x, u)
        path.append(x)
    return np.array(path)


@pytest.fixture(scope="session")
def rollout():
    """States (N, n) that controls (N−1, m) lead to, by forward Euler and nothing else."""
    return _rollout


@pytest.fixture(scope="session")
def cost_of_controls():
    """Effort plus penalty of the path that controls lead to, from the problem's functions."""

    def cost(problem, controls):
        x, dt = _rollout(problem, controls), np.diff(problem.times)
        effort = np.einsum("k,ki,ij,kj", dt, controls, problem.control_weight, controls)
        if getattr(problem, "penalty", None) is None:
            return effort
        c = np.maximum(problem.penalty(problem.times[1:], x[1:]), 0.0)
        return effort + np.einsum("k,p,kp", dt, problem.penalty_weight, c**2)

    return cost


# ------------------------------------------------------------------------------ expected costs


def _stakes_of(problem, *, price, soft, feedback, terminal=None, w=0.0, renewal=0.5):
    """What to charge; the end at 100, or at `terminal`, if it is charged at all."""
    model = model_of(problem)
    given = 100.0 if soft or feedback else 0.0
    stakes = Request(feedback=feedback, expected=True).stakes(model, w)
    q = len(stakes.terminal)
    return dataclasses.replace(
        stakes,
        price=price,
        terminal=np.full(q, given if terminal is None else terminal),
        soft=soft,
        renewal=renewal,
    )


def _nominal(problem):
    """A plan of the mean, where the iteration begins."""
    p = plan(problem, variance_weight=0.0)
    return p.mean, p.controls


def _settle(problem, *, compiled=None, start=None, warm=None, tolerance=1e-14, limit=300, **asked):
    """(posed problem, stakes, answer)."""
    stakes = _stakes_of(problem, **asked)
    posed = pose(model_of(problem), constraints=stakes.priced, compiled=compiled)
    x, u = _nominal(problem) if start is None else start
    answer = solve_noise(posed, stakes, x, u, tolerance=tolerance, max_iterations=limit, warm=warm)
    return posed, stakes, answer


def _mass(*, bounds=None, slip=0.4, walls=True, curved=True, additive=0.05, nodes=13, spread=0.0):
    """A point mass (p, v) whose noise grows with its speed, between affine rows, unevenly timed."""
    shape = np.diag([0.2, 0.1, 0.4, 0.3]) + 0.05
    gaps = 0.1 * (1.0 + 0.3 * np.sin(3.0 * np.arange(nodes - 1)))

    def diffusion(t, x):
        noise = np.zeros((*x.shape, 2), dtype=x.dtype)
        noise[..., 0, 0], noise[..., 1, 1] = slip * x[..., 3], slip * x[..., 2]
        noise[..., 0, 1] = additive
        return noise

    members = {
        "start": np.array([0.0, 0.0, 0.1, -0.1]),
        "start_covariance": spread**2 * (np.eye(4) + 0.5),
        "times": np.concatenate([[0.0], np.cumsum(gaps)]),
        "control_weight": np.array([[1.0, 0.2], [0.2, 0.6]]),
        "drift": lambda t, x, u: np.concatenate([x[..., 2:], u], axis=-1),
        "diffusion": diffusion,
        "terminal": lambda x: x - np.array([1.0, 0.7, 0.0, 0.0]),
        "control_bounds": bounds,
    }
    if walls:
        members |= {
            "penalty": lambda t, x: x[..., 1:2] - 0.8 * x[..., :1] - 0.02,
            "penalty_weight": np.array([40.0]),
            "constraint": lambda t, x: np.stack([x[..., 0] - 1.15, -0.1 - x[..., 1]], axis=-1),
        }
    if curved:
        members["state_cost"] = lambda t, x: np.einsum("...i,ij,...j", x, shape, x)
    return types.SimpleNamespace(**members)


@pytest.fixture(scope="session")
def expected_stakes():
    """What is charged of a problem, by its keywords."""
    return _stakes_of


@pytest.fixture(scope="session")
def nominal():
    """Means and controls where the iteration on expected costs begins."""
    return _nominal


@pytest.fixture(scope="session")
def settle():
    """The iteration on expected costs, to the end: (posed problem, stakes, answer)."""
    return _settle


@pytest.fixture(scope="session")
def mass():
    """A point mass between walls, by its keywords."""
    return _mass
