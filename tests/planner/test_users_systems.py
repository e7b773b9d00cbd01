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
@pytest.mark.parametrize("name", ["Rocket", "CartPole"])
def test_units_change_neither_iterations_nor_plan(systems, name, units):
    module, system = systems("units"), systems("catalogue").SYSTEMS[name]
    chosen = {each.name: each for each in module.CHOICES}[units]
    factors = module.factors(system.dimensions, chosen)
    p = plan(system.make(), variance_weight=0.0)
    q = plan(module.in_units(system.make(), system.dimensions, chosen), variance_weight=0.0)
    assert (q.status, q.iterations) == (p.status, p.iterations)
    for there, here, factor in (
        (q.mean, p.mean, factors.states),
        (q.controls, p.controls, factors.controls),
    ):
        size = np.abs(here).max(axis=0)
        np.testing.assert_allclose(there / factor / size, here / size, rtol=0.0, atol=1e-9)
