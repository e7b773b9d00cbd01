"""The paper's case with its reference, and tools that know the dynamics but not the planner."""

import json
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import plan


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
    return plan(paper, variance_weight=0.0, tolerance=1e-10)


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
