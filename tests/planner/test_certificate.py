"""The certificate against closed forms, finite differences, SciPy and what must not pass."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize

from slipcar.envs import Scenario
from slipcar.planner import Plan, Status, plan
from slipcar.planner.extremal.certificate import certify, violations
from slipcar.planner.extremal.maximum_principle import (
    adjoint_of,
    best_step,
    first_order,
    minimize_over_controls,
)
from slipcar.planner.extremal.second_order import second_order
from slipcar.planner.moments import covariance as moments
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import model_of


class Cart:
    """A double integrator from rest at 0 to rest at 1 in T seconds."""

    start = np.zeros(2)

    def __init__(self, horizon=2.0, nodes=41, control_weight=1.0, **members):
        self.times = np.linspace(0.0, horizon, nodes)
        self.control_weight = control_weight * np.eye(1)
        self.__dict__.update(members)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.zeros((*x.shape[:-1], 2, 1))

    def terminal(self, x):
        return x - np.array([1.0, 0.0])


def hamiltonian(model, t, x, p, u):
    """H up to what does not depend on u, p the adjoints at the ends of the intervals."""
    b = model.drift(*(np.broadcast_to(z, (*u.shape[:-1], *z.shape[1:])) for z in (t, x)), u)
    return np.einsum("...i,...i->...", p, b) - np.einsum("...i,ij,...j->...", u, model.R, u)


def held_variance_gradient(at, A_x, S, variance_weight):
    """What the adjoint equation leaves out by holding Λ: the gradient of w ∫ tr Σ through A.

    ∂/∂A_k of w Σ dt tr Σ_k  =  2 w Λ_{k+1} A_k Σ_k
    """
    gradient = np.zeros_like(at.lin.defect)
    force = 2.0 * variance_weight * at.weights @ at.lin.A @ S[:-1]
    gradient[:-1] = np.einsum("kab,kabi->ki", force, A_x)[1:]
    return gradient


@pytest.fixture(scope="module")
def tight(paper):
    return plan(paper, tolerance=1e-10)


@pytest.fixture(scope="module")
def some_trajectory(paper):
    """Controls that solve nothing, and the states they lead to are not even used."""
    rng = np.random.default_rng(5)
    x, u = paper.initial_guess()
    return x + 0.3 * rng.normal(size=x.shape), u + rng.normal(size=u.shape)


# ---------------------------------------------------------------- the paper's case


def test_multipliers_of_the_paper_case_agree_with_the_reference(exact_paper_plan, reference):
    c = certify(exact_paper_plan)
    assert c.extremal
    known = np.array(reference["clearance_0.13"]["terminal_multiplier_abs"])
    found = np.abs(c.multipliers.terminal / c.multipliers.cost)
    np.testing.assert_allclose(found, known, rtol=1e-5)
    # The multiplier of x(T) = x^f is p(T) itself, but for the push of obstacles at the end.
    np.testing.assert_allclose(np.abs(c.adjoint[-1]), known, rtol=1e-5)


@pytest.mark.parametrize("weight", [0.0, 1.0, 30.0])
def test_a_tighter_stopping_rule_makes_a_smaller_residual(paper, weight):
    for tolerance, limit in ((1e-3, 3e-2), (1e-6, 2e-3), (1e-10, 1e-4)):
        c = certify(plan(paper, variance_weight=weight, tolerance=tolerance))
        assert c.residual < limit


def test_multipliers_are_normalised_and_the_cost_counts_at_every_iteration(tight):
    c = certify(tight)
    assert c.normal
    lengths = np.sqrt(
        np.sum(c.terminal_history**2, axis=1) + c.cost_history**2 + c.trust_region_history**2
    )
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-14)
    assert len(c.cost_history) == tight.iterations
    assert np.all(c.cost_history < 0.0)
    assert c.smallest_cost_multiplier == np.min(np.abs(c.cost_history))
    ratio = c.terminal_history[-1] / c.cost_history[-1]
    np.testing.assert_allclose(ratio, tight.history[-1].terminal_multiplier, rtol=1e-12)
    # p(t), normalised, is the recursion's to the residual.
    scale = -c.multipliers.cost
    np.testing.assert_allclose(c.multipliers.adjoint, scale * c.adjoint, atol=1e-5)


def test_no_other_control_makes_the_hamiltonian_larger(paper, tight):
    c, model = certify(tight), model_of(paper)
    v = np.random.default_rng(0).uniform(model.lower, model.upper, size=(500, 40, 2))
    t, x, p = tight.times[:-1], tight.mean[:-1], c.adjoint[1:]
    H = hamiltonian(model, t, x, p, tight.controls)
    assert np.all(hamiltonian(model, t, x, p, v) <= H + c.violations.hamiltonian + 1e-12)
    assert c.violations.hamiltonian < 1e-9


# ---------------------------------------------------------------- the adjoint equation


def test_the_adjoint_is_the_gradient_of_cost_and_terminal_condition(paper, rollout):
    rng = np.random.default_rng(3)
    u, direction = rng.normal(size=(2, 40, 2))
    nu = rng.normal(size=5)
    model = model_of(paper)

    def lagrangian(v):
        x = rollout(paper, v)
        lin = linearize(model, x, v)
        return lin.effort + lin.penalty + nu @ lin.g

    at = first_order(model, rollout(paper, u), u, 0.0)
    slope = np.vdot(at.sub.slope(adjoint_of(model, at, nu)), direction)
    h = 1e-6
    change = (lagrangian(u + h * direction) - lagrangian(u - h * direction)) / (2.0 * h)
    assert slope == pytest.approx(change, rel=1e-7)


def test_held_part_and_the_rest_are_the_whole_gradient_of_the_variance(paper, some_trajectory):
    model, w = model_of(paper), 2.5
    x, u = some_trajectory
    direction = np.random.default_rng(1).normal(size=x.shape)
    direction[0] = 0.0

    def variance(y):
        lin = linearize(model, y, u)
        S = moments.covariance(lin.A, lin.sigma, model.dt)
        return w * moments.trace_integral(S, model.dt)

    at, bare = first_order(model, x, u, w), first_order(model, x, u, 0.0)
    zero = np.zeros((40, 5))
    A_x = second_order(model, at, zero, np.zeros(5), w).A_x
    S = moments.covariance(at.lin.A, at.lin.sigma, model.dt)
    left_out = held_variance_gradient(at, A_x, S, w)
    kept = at.state_gradient - bare.state_gradient
    h = 1e-6
    change = (variance(x + h * direction) - variance(x - h * direction)) / (2.0 * h)
    assert np.vdot(kept + left_out, direction[1:]) == pytest.approx(change, rel=1e-6)
    assert abs(np.vdot(left_out, direction[1:])) > 1e-3 * abs(change)  # it is not nothing


def test_what_holding_lambda_leaves_out_is_small_on_the_paper_case(paper, tight):
    at = first_order(model_of(paper), tight.mean, tight.controls, 1.0)
    adjoint = adjoint_of(model_of(paper), at, -tight.multipliers.terminal)
    A_x = second_order(model_of(paper), at, adjoint, np.zeros(5), 1.0).A_x
    left_out = held_variance_gradient(at, A_x, tight.covariance, 1.0)
    assert 0.0 < np.max(np.abs(left_out)) < 1e-4 * np.max(np.abs(adjoint))


def test_minimum_energy_has_a_constant_and_a_linear_costate():
    p = plan(Cart(), tolerance=1e-12)
    c = certify(p)
    assert c.residual < 1e-9
    np.testing.assert_allclose(c.adjoint[:, 0], c.adjoint[0, 0], rtol=1e-9)
    np.testing.assert_allclose(np.diff(c.adjoint[:, 1], 2), 0.0, atol=1e-9)
    # H = p_r v + p_v u − u² is largest at u = p_v / 2.
    np.testing.assert_allclose(p.controls[:, 0], 0.5 * c.adjoint[1:, 1], atol=1e-9)
    # Continuous limit: u = (6/T²)(1 − 2t/T), so p_r = −dp_v/dt = 24/T³.
    fine = certify(plan(Cart(nodes=1001), tolerance=1e-12))
    assert fine.adjoint[0, 0] == pytest.approx(24.0 / 2.0**3, rel=1e-5)


# ---------------------------------------------------------------- the argmax


@pytest.mark.parametrize("radius", [np.inf, 0.8])
@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("coupled", [False, True])
def test_argmax_over_controls_against_scipy(coupled, box, radius):
    rng = np.random.default_rng(11)
    K, m = 12, 3
    L = rng.normal(size=(K, m, m)) if coupled else np.eye(m) * rng.uniform(0.5, 2, (K, m, 1))
    R = L @ L.swapaxes(1, 2) + 0.2 * np.eye(m)
    r, u = 2.0 * rng.normal(size=(K, m)), 0.2 * rng.normal(size=(K, m))
    model = dataclasses.replace(
        model_of(Cart()),
        lower=np.full(m, -0.5 if box else -np.inf),
        upper=np.full(m, 0.6 if box else np.inf),
        radius=radius,
    )
    e = minimize_over_controls(model, R, r, u)
    bounds = list(zip(model.lower, model.upper, strict=True))
    inside = [{"type": "ineq", "fun": lambda v: radius**2 - v @ v}] if radius < np.inf else []
    for k in range(K):
        known = minimize(
            lambda v, k=k: 0.5 * (v - u[k]) @ R[k] @ (v - u[k]) + r[k] @ (v - u[k]),
            np.zeros(m),
            bounds=bounds,
            constraints=inside,
            method="SLSQP",
            options={"ftol": 1e-15, "maxiter": 300},
        )
        np.testing.assert_allclose(u[k] + e[k], known.x, atol=2e-6)
        assert np.linalg.norm(u[k] + e[k]) <= radius * (1.0 + 1e-12)


def test_the_plans_control_is_its_own_argmax_at_active_bounds(paper):
    p = plan(paper.replace(control_bounds=(0.7, 1.45)), tolerance=1e-10)
    assert p.status is Status.CONVERGED
    assert np.isclose(np.abs(p.controls), [0.7, 1.45], atol=1e-12).any()
    c = certify(p)
    assert c.extremal
    assert c.residual < 1e-4
    assert c.violations.bounds == 0.0


# ---------------------------------------------------------------- what must not pass


def test_a_perturbed_control_is_found(tight):
    u = tight.controls.copy()
    u[7, 1] += 1e-3
    c = certify(tight.replace(controls=u), tolerance=1e-4)
    assert not c.extremal
    assert c.violations.control == pytest.approx(1e-3, rel=0.02)
    # dt H loses ½ eᵀ(2 dt R)e: H loses e².
    assert c.violations.hamiltonian == pytest.approx(1e-6, rel=0.05)
    assert c.violations.dynamics == pytest.approx(0.125e-3, rel=1e-3)


@pytest.mark.parametrize("row", range(5))
def test_a_perturbed_multiplier_is_found(tight, row):
    own = tight.multipliers
    terminal = own.terminal.copy()
    terminal[row] += 0.1
    c = certify(tight.replace(multipliers=dataclasses.replace(own, terminal=terminal)))
    assert not c.extremal
    assert c.adjoint_difference >= 0.1 * (1.0 - 1e-4)
    assert c.residuals["u = argmax H"] > 1e-2


def test_a_mean_that_the_controls_do_not_cause_is_found(tight):
    x = tight.mean.copy()
    x[20, 0] += 0.01
    c = certify(tight.replace(mean=x))
    assert not c.extremal
    assert c.violations.dynamics == pytest.approx(0.01, rel=1e-6)
    assert "dynamics" in str(c)


def test_a_missed_goal_is_found(paper, tight):
    moved = paper.replace(goal=paper.goal + np.array([0.0, 0.01, 0.0, 0.0, 0.0]))
    c = certify(tight.replace(problem=moved))
    assert not c.extremal
    assert c.violations.terminal == pytest.approx(0.01, rel=1e-6)


def test_controls_beyond_their_bounds_are_found(paper, tight):
    c = certify(tight.replace(problem=paper.replace(control_bounds=(2.0, 1.4))))
    assert not c.extremal
    excess = np.max(np.abs(tight.controls[:, 1])) - 1.4
    assert c.violations.bounds == pytest.approx(excess, rel=1e-9)


def test_an_optimum_of_another_problem_is_none(paper, tight):
    assert not certify(tight.replace(problem=paper.replace(clearance=0.2))).extremal


@pytest.mark.parametrize("iterations", [1, 2, 4])
def test_an_unfinished_plan_is_no_extremal(paper, iterations):
    p = plan(paper, max_iterations=iterations)
    assert p.status is Status.MAX_ITERATIONS
    c = certify(p)
    assert not c.extremal
    assert c.residual > 0.05


def test_a_plan_that_cannot_reach_its_goal_gets_a_no_and_no_error(paper):
    p = plan(paper.replace(control_bounds=(0.1, 0.1)), max_iterations=60)
    assert not p.status.ok
    c = certify(p)
    assert not c.extremal
    assert c.relaxed.any()
    assert c.violations.terminal > 0.1
    assert "NO extremal" in str(c)


def test_numbers_that_are_none_get_a_no(tight):
    x = tight.mean.copy()
    x[3, 2] = np.nan
    c = certify(tight.replace(mean=x))
    assert not c.extremal
    assert c.residual == np.inf
    assert "NO extremal" in str(c)


def test_a_vanishing_cost_multiplier_is_abnormal(tight):
    last = tight.history[-1]
    huge = dataclasses.replace(last, terminal_multiplier=1e16 * last.terminal_multiplier)
    c = certify(tight.replace(history=(*tight.history[:-1], huge)))
    assert not c.normal
    assert not c.extremal
    assert "abnormal" in str(c)


def test_a_plan_without_its_problem_is_refused(tight, tmp_path):
    lost = Plan.load(tight.save(tmp_path / "plan.npz"))
    if lost.problem is None:
        lost = lost.replace(problem=None)
    with pytest.raises(ValueError, match="does not know its problem"):
        certify(lost.replace(problem=None))
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="tolerance"):
            certify(tight, tolerance=bad)


# ---------------------------------------------------------------- scales, time, words


def test_units_of_cost_do_not_matter(paper):
    class Cheaper:
        control_weight = 1e-6 * np.eye(2)
        penalty_weight = 1e-6 * paper.penalty_weight

        def __getattr__(self, name):
            return getattr(paper, name)

    # The same path under both prices, each with its own multipliers.
    a = plan(paper, variance_weight=1.0, tolerance=1e-8)
    b = a.replace(
        problem=Cheaper(),
        options={**a.options, "variance_weight": 1e-6},
        multipliers=dataclasses.replace(
            a.multipliers,
            terminal=1e-6 * a.multipliers.terminal,
            adjoint=1e-6 * a.multipliers.adjoint,
        ),
    )
    one, other = certify(a).residuals, certify(b).residuals
    for name, value in one.items():
        assert other[name] == pytest.approx(value, rel=1e-6, abs=1e-12)


def test_transversality_is_how_the_cost_changes_with_the_horizon():
    h = 1e-4
    costs = [plan(Cart(T), tolerance=1e-14).effort for T in (2.0 - h, 2.0 + h)]
    slope = (costs[1] - costs[0]) / (2.0 * h)
    p = plan(Cart(2.0), tolerance=1e-14)
    assert certify(p, time_weight=0.0).transversality == pytest.approx(-slope, rel=1e-6)
    # With time at exactly that price, two seconds are the optimal time.
    free = certify(p, time_weight=-slope)
    assert free.extremal
    assert free.residuals["transversality"] < 1e-5
    assert not certify(p, time_weight=-2.0 * slope).extremal
    assert "final time" in str(free)


def test_transversality_of_the_car(paper):
    h = 1e-3
    costs = [
        plan(paper.replace(horizon=T), variance_weight=0.0, tolerance=1e-14).cost
        for T in (5.0 - h, 5.0 + h)
    ]
    slope = (costs[1] - costs[0]) / (2.0 * h)
    p = plan(paper, variance_weight=0.0, tolerance=1e-14)
    assert certify(p, time_weight=0.0).transversality == pytest.approx(-slope, rel=1e-4)


def test_a_fixed_horizon_has_no_transversality_condition(tight):
    c = certify(tight)
    assert c.transversality is None
    assert "transversality" not in c.residuals


def test_the_verdict_is_short_and_says_what_it_is(paper, tight):
    for p in (tight, plan(paper, max_iterations=2)):
        lines = str(certify(p)).splitlines()
        assert 5 <= len(lines) <= 8
        assert max(map(len, lines)) <= 100
    assert str(certify(tight)).startswith("EXTREMAL to ")
    assert "CONVERGED" in str(certify(tight))


def test_a_certificate_looks_at_the_plan_and_not_at_its_status(tight):
    assert certify(tight.replace(status=Status.MAX_ITERATIONS)).extremal


def test_violations_of_an_iterate_are_those_of_its_certificate(paper, tight):
    v = violations(
        model_of(paper),
        tight.mean,
        tight.controls,
        -tight.multipliers.terminal,
        variance_weight=1.0,
    )
    c = certify(tight)
    assert v.relative == c.violations.relative
    at = first_order(model_of(paper), tight.mean, tight.controls, 1.0)
    e, gain = best_step(model_of(paper), at, v.adjoint)
    assert v.control == np.max(np.abs(e))
    assert v.hamiltonian == max(0.0, np.max(gain))


@pytest.mark.parametrize("seed", [0, 3, 8])
def test_plans_of_random_worlds_are_extremals(seed):
    p = plan(Scenario.random(seed), tolerance=1e-8)
    assert p.status is Status.CONVERGED
    assert certify(p, tolerance=1e-3).extremal
