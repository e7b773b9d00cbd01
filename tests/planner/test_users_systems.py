"""Systems as users write them: solved, certified, as cheap as IPOPT's plan, in whatever units.

The optima of the first seven were computed independently, by another transcription with IPOPT.
"""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from slipcar.planner import Status, plan

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
SEVEN = ("CartPole", "Rocket", "Quad12", "Dubins", "Race", "Corridor", "CSTR")


@pytest.fixture(scope="module")
def systems():
    """Modules of benchmarks/systems that need no other solver, by name."""
    sys.path.insert(0, str(FOLDER))
    yield lambda name: importlib.import_module(f"systems.{name}")
    sys.path.remove(str(FOLDER))


@pytest.mark.parametrize("name", [*SEVEN, "Arm", "FreeFlyer", "Rendezvous", "Glucose", "Upright"])
def test_the_default_call_is_certified_and_within_a_percent_of_ipopt(systems, name):
    system = systems("catalogue").SYSTEMS[name]
    p = plan(system.make(), variance_weight=0.0)
    assert p.status is Status.CONVERGED
    assert p.certificate.extremal, str(p.certificate)
    cost = p.effort + p.running_cost + p.obstacle_cost
    assert cost <= system.optimum + 0.01 * abs(system.optimum)


def test_an_inverted_pendulum_stands_for_twenty_seconds(systems):
    make = systems("mechanisms").Upright
    for seconds in (10.0, 20.0):
        p = plan(make(seconds), variance_weight=0.0, tolerance=1e-8)
        assert p.status is Status.CONVERGED
        assert p.effort == pytest.approx(5.703873, abs=1e-6)


class Coupled:
    """Two controls whose weights are coupled and whose own cost is least elsewhere."""

    start, times = np.array([0.0, 0.0]), np.linspace(0.0, 2.0, 21)
    control_weight = np.array([[1.0, 0.99], [0.99, 1.0]])

    def drift(self, t, x, u):
        return np.stack([u[..., 0] + np.sin(x[..., 1]), u[..., 1] - x[..., 0] ** 2], axis=-1)

    def diffusion(self, t, x):
        return np.zeros((*x.shape, 1))

    def control_cost(self, t, x):
        return np.stack([np.sin(x[..., 0]), 0.5 + 0.0 * x[..., 0]], axis=-1)

    def terminal(self, x):
        return x - np.array([1.0, -1.0])


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-10])
def test_coupled_control_weights_are_certified_at_the_plans_own_tolerance(tolerance):
    p = plan(Coupled(), variance_weight=0.0, tolerance=tolerance)
    assert p.status is Status.CONVERGED
    assert p.certificate.residuals["u = argmax H"] <= np.sqrt(tolerance)


class Nowhere(Coupled):
    """Ends that contradict each other, in small units."""

    control_weight = 1e6 * np.eye(2)

    def terminal(self, x):
        return 1e-3 * np.stack([x[..., 0] - 1.0, x[..., 0] - 2.0], axis=-1)


def test_contradictory_ends_are_named_whatever_the_status():
    p = plan(Nowhere(), variance_weight=0.0)
    assert not p.status.ok
    assert "g[" in p.message


@pytest.mark.parametrize("name", ["CartPole", "Arm", "CSTR"])
@pytest.mark.parametrize("seed", range(4))
def test_disturbed_guesses_converge(systems, name, seed):
    problem = systems("catalogue").SYSTEMS[name].make()
    known = plan(problem, variance_weight=0.0)
    guess = systems("guesses").disturbed(problem, (known.mean, known.controls), seed)
    p = plan(problem, variance_weight=0.0, guess=guess, cold_start="never")
    assert p.status is Status.CONVERGED
    assert p.certificate.extremal, str(p.certificate)


@pytest.mark.parametrize("units", ["mm", "km", "kN", "µs", "cost × 1e4"])
@pytest.mark.parametrize("name", ["Rocket", "CartPole", "Rendezvous in a ball", "Rocket, convex"])
def test_units_change_neither_iterations_nor_plan(systems, name, units):
    kind, _, variant = name.replace(",", " ").partition(" ")
    module, system = systems("units"), systems("catalogue").SYSTEMS[kind]
    chosen = {each.name: each for each in module.CHOICES}[units]
    factors = module.factors(system.dimensions, chosen)
    here, asked = system.make(), {"variance_weight": 0.0}
    if "convex" in variant:
        asked["method"] = "convex"
    if "ball" in variant:  # which the free plan would leave
        free = np.linalg.norm(plan(here, **asked).controls, axis=1)
        here.control_radius = float(0.8 * free.max())
    p = plan(here, **asked)
    q = plan(module.in_units(here, system.dimensions, chosen), **asked)
    assert p.status is Status.CONVERGED
    if "ball" in variant:
        assert np.isclose(np.linalg.norm(p.controls, axis=1).max(), here.control_radius)
    assert (q.status, q.iterations) == (p.status, p.iterations)
    for there, here, factor in (
        (q.mean, p.mean, factors.states),
        (q.controls, p.controls, factors.controls),
    ):
        size = np.abs(here).max(axis=0)
        np.testing.assert_allclose(there / factor / size, here / size, rtol=0.0, atol=1e-9)
