"""Shooting: its order, its accuracy, where it lands, and how it fails."""

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.extremal.certificate import certify
from slipcar.planner.extremal.maximum_principle import first_order, model_for
from slipcar.planner.extremal.second_order import second_order
from slipcar.planner.extremal.shooting import (
    START_WITHIN,
    retry_within,
    shoot,
    shoot_from,
)
from slipcar.planner.moments import covariance as moments
from slipcar.planner.problem.model import model_of
from slipcar.planner.records import Multipliers


class Pendulum:
    """Jacobians left out; two Brownian motions; an uneven grid."""

    start = np.array([0.2, 0.0])
    times = np.concatenate([np.linspace(0.0, 0.5, 9), np.linspace(0.6, 1.5, 10)])
    control_weight = np.array([[0.5]])

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - 9.81 * np.sin(x[..., 0]) - 0.1 * x[..., 1]], -1)

    def diffusion(self, t, x):
        return 0.1 * np.broadcast_to([[1.0, 0.5], [2.0, 3.0]], (*x.shape[:-1], 2, 2))

    def terminal(self, x):
        return x - np.array([1.5, 0.0])


class Tip(Pendulum):
    """The tip at a height, with no matter which speed: one non-linear terminal condition."""

    def terminal(self, x):
        return np.cos(x[..., :1]) - 0.2


class Unicycle:
    """∂²b/∂x∂u ≠ 0: speed and yaw rate as controls, to a pose."""

    start = np.array([0.0, 0.0, 0.3])
    times = np.linspace(0.0, 2.0, 17)
    control_weight = np.diag([1.0, 0.3])

    def drift(self, t, x, u):
        v, theta = u[..., 0], x[..., 2]
        return np.stack([v * np.cos(theta), v * np.sin(theta), u[..., 1]], -1)

    def diffusion(self, t, x):
        return 0.1 * np.broadcast_to([[1.0], [0.3], [0.0]], (*x.shape[:-1], 3, 1))

    def terminal(self, x):
        return x - np.array([1.0, 1.2, 1.0])

    def initial_guess(self):
        u = np.tile([1.0, 0.35], (16, 1))
        x = np.empty((17, 3))
        x[0] = self.start
        for k in range(16):
            x[k + 1] = x[k] + 0.125 * self.drift(0.0, x[k], u[k])
        return x, u


class Variant:
    """A scenario with members of its own."""

    def __init__(self, base, **members):
        self.__dict__.update(members)
        self.base = base

    def __getattr__(self, name):
        return getattr(self.base, name)


def speed_cost(t, x):
    return 0.5 * x[..., 3] ** 2 + 0.1 * np.cos(x[..., 0])


def steering_cost(t, x):
    return np.stack([0.3 * np.sin(x[..., 0]), 0.2 * x[..., 3]], -1)


def improved(p, shot):
    """The plan with a converged shot's trajectory and multipliers in place of its own."""
    at = shot.at
    S = moments.covariance_of(model_for(p), at)
    return p.replace(
        status=Status.CONVERGED, mean=at.x, controls=at.u, covariance=S, effort=at.effort,
        obstacle_cost=at.penalty, running_cost=at.running,
        variance=moments.trace_integral(S, np.diff(p.times)),
        multipliers=Multipliers.of(shot.adjoint, shot.terminal, 0.0, at.A),
        A=at.A, B=at.B, gains=None, solve_time=p.solve_time + shot.seconds, message="",
    )  # fmt: skip


def near(p, start_within=START_WITHIN):
    """The first shot that converges from an iterate near enough."""
    limit = start_within
    for k, h in enumerate(p.history):
        if h.accepted:
            shot = shoot_from(p, k, start_within=limit)
            if shot.converged:
                return k, shot
            limit = retry_within(shot, limit)
    return None


# ---------------------------------------------------------------- the paper's case


@pytest.mark.parametrize("weight", [0.0, 1.0, 10.0])
def test_convergence_is_quadratic(paper, weight):
    p = plan(paper, variance_weight=weight, tolerance=1e-6, method="convex")
    pairs = []
    for k in range(3, 9):
        shot = shoot_from(p, k)
        assert shot.converged
        r = shot.residuals
        late = r[1:][(r[:-1] < 0.1) & (r[1:] > 1e-13)], r[:-1][(r[:-1] < 0.1) & (r[1:] > 1e-13)]
        pairs += list(zip(*late, strict=True))
        assert all(h.step == 1.0 for h in shot.history[-2:])
    after, before = np.log(pairs).T
    assert before.min() < np.log(1e-5) < np.log(1e-2) < before.max()  # over many decades
    order = np.polyfit(before, after, 1)[0]
    assert 1.7 < order < 2.4


@pytest.mark.parametrize("weight", [0.0, 1.0, 10.0])
def test_it_agrees_with_scp_run_to_the_end(paper, weight):
    p = plan(paper, variance_weight=weight, tolerance=1e-22, max_iterations=200, method="convex")
    shot = shoot_from(p, 5)
    assert shot.converged
    np.testing.assert_allclose(shot.at.u, p.controls, atol=1e-8)
    np.testing.assert_allclose(shot.at.x, p.mean, atol=1e-8)
    np.testing.assert_allclose(-shot.adjoint, p.multipliers.adjoint[1:], atol=1e-6)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_every_later_iterate_leads_to_the_same_extremal(paper, weight):
    p = plan(paper, variance_weight=weight, tolerance=1e-10, method="convex")
    ends = [shoot_from(p, k) for k in range(4, p.iterations)]
    assert all(shot.converged for shot in ends)
    for shot in ends[1:]:
        np.testing.assert_allclose(shot.at.u, ends[0].at.u, atol=1e-10)
    # The later the start, the fewer the steps.
    assert ends[-1].iterations <= 2 < ends[0].iterations


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_the_improved_plan_is_an_extremal_to_twelve_digits(paper, weight):
    p = plan(paper, variance_weight=weight, max_iterations=6, method="convex")
    shot = shoot_from(p)
    q = improved(p, shot)
    assert q.status is Status.CONVERGED
    c = certify(q, tolerance=1e-10)
    assert c.extremal
    assert shot.residual <= 1e-12
    assert np.all(np.abs(q.controls) <= paper.control_bounds)
    tight = plan(paper, variance_weight=weight, tolerance=1e-14)
    assert q.cost == pytest.approx(tight.cost, rel=1e-9)
    assert q.variance == pytest.approx(tight.variance, rel=1e-7)
    np.testing.assert_allclose(q.covariance, tight.covariance, atol=1e-8)


def test_other_start_multipliers_lead_to_the_same_end(paper):
    p = plan(paper, max_iterations=7, method="convex")
    model = model_for(p)
    nu = -p.multipliers.terminal
    own = shoot(model, p.mean, p.controls, nu, adjoint=-p.multipliers.adjoint[1:])
    rerun = shoot(model, p.mean, p.controls, nu)
    assert own.converged
    assert rerun.converged
    np.testing.assert_allclose(own.at.u, rerun.at.u, atol=1e-10)


# ---------------------------------------------------------------- other systems

SYSTEMS = {
    "complex-step Jacobians": (Pendulum(), {}),
    "rk4": (Pendulum(), {"integrator": "rk4"}),
    "non-linear terminal condition": (Tip(), {}),
    "mixed second derivatives": (Unicycle(), {}),
    "mixed, rk4": (Unicycle(), {"integrator": "rk4"}),
    "active bounds": (Scenario.named("paper").replace(control_bounds=(0.7, 1.45)), {}),
    "terminal box": (Scenario.named("paper"), {"terminal_tolerance": 0.05}),
    "large variance weight": (Scenario.named("open"), {"variance_weight": 300.0}),
    "ball": (Variant(Scenario.named("paper"), control_bounds=None, control_radius=1.0), {}),
    "ball and box": (
        Variant(Scenario.named("paper"), control_bounds=np.array([0.7, 4.0]), control_radius=1.3),
        {},
    ),
    "running costs": (
        Variant(Scenario.named("paper"), state_cost=speed_cost, control_cost=steering_cost),
        {},
    ),
    "full R, active bounds": (
        Variant(
            Scenario.named("paper"),
            control_weight=np.array([[1.0, 0.6], [0.6, 0.8]]),
            control_bounds=np.array([0.7, 1.2]),
        ),
        {},
    ),
    "a fine grid": (Scenario.named("paper").replace(nodes=321), {}),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_other_systems(name):
    problem, options = SYSTEMS[name]
    p = plan(problem, tolerance=1e-9, **options)
    assert p.status is Status.CONVERGED
    found = near(p)
    assert found is not None
    _, shot = found
    scale = np.max(np.abs(p.controls))
    np.testing.assert_allclose(shot.at.u, p.controls, atol=2e-4 * scale)
    q = improved(p, shot)
    c = certify(q, tolerance=1e-9)
    assert c.extremal
    assert c.violations.bounds == 0.0
    # From a start a little away: quadratic again.
    rng = np.random.default_rng(2)
    nudged = shoot(
        model_for(p),
        q.mean + 3e-3 * rng.normal(size=q.mean.shape) * (np.arange(len(q.mean)) > 0)[:, None],
        model_for(p).admissible(q.controls + 3e-3 * scale * rng.normal(size=q.controls.shape)),
        shot.terminal,
        adjoint=shot.adjoint,
        variance_weight=p.options["variance_weight"],
        terminal_tolerance=p.options["terminal_tolerance"],
    )
    assert nudged.converged
    np.testing.assert_allclose(nudged.at.u, shot.at.u, atol=1e-9 * scale)
    assert np.min(nudged.residuals[2:] / nudged.residuals[1:-1] ** 1.7) < 100.0


def test_a_linear_quadratic_problem_takes_one_step():
    s = Scenario.named("open")

    class Linear(Variant):
        def drift(self, t, x, u):
            return np.stack([x[..., 3], x[..., 4], 0 * x[..., 2], u[..., 0], u[..., 1]], -1)

        def drift_jacobian(self, t, x, u):
            A, B = np.zeros((*x.shape, 5)), np.zeros((*x.shape, 2))
            A[..., 0, 3] = A[..., 1, 4] = B[..., 3, 0] = B[..., 4, 1] = 1.0
            return A, B

        def terminal(self, x):
            return x[..., [0, 1, 3, 4]] - np.array([1.0, 2.0, 0.0, 0.0])

        def terminal_jacobian(self, x):
            return np.broadcast_to(np.eye(5)[[0, 1, 3, 4]], (*x.shape[:-1], 4, 5))

    problem = Linear(s, control_bounds=None, initial_guess=None)
    rng = np.random.default_rng(0)
    shot = shoot(
        model_of(problem),
        np.vstack([s.start, rng.normal(size=(40, 5))]),
        rng.normal(size=(40, 2)),
        rng.normal(size=4),
        variance_weight=0.0,
    )
    assert shot.converged
    # (One more removes what differences leave of second derivatives that are zero.)
    assert shot.iterations <= 2
    assert shot.residuals[1] < 1e-8
    np.testing.assert_allclose(
        shot.at.u, plan(problem, variance_weight=0.0, tolerance=1e-16).controls, atol=1e-9
    )


def test_second_derivatives_in_closed_form():
    model = model_of(Unicycle())
    rng = np.random.default_rng(4)
    x, u = rng.normal(size=(17, 3)), rng.normal(size=(16, 2))
    lam, nu = rng.normal(size=(16, 3)), rng.normal(size=3)
    second = second_order(model, first_order(model, x, u, 0.0), lam, nu, 0.0)
    theta, v, dt = x[:-1, 2], u[:, 0], 0.125
    along = -dt * v * (lam[:, 0] * np.cos(theta) + lam[:, 1] * np.sin(theta))
    expected = np.zeros((16, 3, 3))
    expected[:-1, 2, 2] = along[1:]
    np.testing.assert_allclose(second.xx, expected, atol=1e-9)
    mixed = np.zeros((16, 2, 3))
    mixed[:, 0, 2] = dt * (-lam[:, 0] * np.sin(theta) + lam[:, 1] * np.cos(theta))
    np.testing.assert_allclose(second.ux, mixed, atol=1e-9)
    np.testing.assert_allclose(second.uu, np.broadcast_to(0.25 * model.R, (16, 2, 2)), atol=1e-12)
    bend = np.zeros((16, 3, 3, 3))
    bend[:, 0, 2, 2], bend[:, 1, 2, 2] = -dt * v * np.cos(theta), -dt * v * np.sin(theta)
    np.testing.assert_allclose(second.A_x, bend, atol=1e-9)


# ---------------------------------------------------------------- random worlds


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_random_worlds(weight):
    plans = [
        plan(
            Scenario.random(seed, turned=True),
            variance_weight=weight,
            tolerance=1e-10,
            method="convex",
        )
        for seed in range(40)
    ]
    settled = [p for p in plans if p.status is Status.CONVERGED]
    assert len(settled) >= 36
    shots = [near(p) for p in settled]
    hits = [(p, *found) for p, found in zip(settled, shots, strict=True) if found is not None]
    assert len(hits) >= 0.95 * len(settled)
    for p, k, shot in hits:
        # The extremal that SCP is on its way to, reached before SCP is there.
        scale = np.max(np.abs(p.controls))
        np.testing.assert_allclose(shot.at.u, p.controls, atol=1e-3 * scale)
        assert shot.residual <= 1e-12
        assert certify(improved(p, shot), tolerance=1e-9).extremal
        assert k < p.iterations
    saved = [p.iterations - (k + 1) for p, k, _ in hits]
    assert np.median(saved) >= 3


# ---------------------------------------------------------------- failing


def test_what_cannot_be_reached_fails_cleanly(paper):
    p = plan(paper.replace(control_bounds=(0.1, 0.1)), max_iterations=30)
    for k in (None, 0, 5, -1):
        shot = shoot_from(p, k)
        assert not shot.converged
        assert shot.message


def test_garbage_fails_cleanly(paper):
    model, rng = model_of(paper), np.random.default_rng(9)
    for size in (1.0, 1e3, 1e200, np.nan):
        x = size * rng.normal(size=(41, 5))
        shot = shoot(model, x, size * rng.normal(size=(40, 2)), size * rng.normal(size=5))
        assert shot.converged is (shot.residual <= 1e-12)
        assert len(shot.history) == shot.iterations + 1


def test_a_start_too_far_away_is_left_to_scp(paper):
    p = plan(paper, tolerance=1e-10)
    far = shoot_from(p, 1, start_within=START_WITHIN)
    assert not far.converged
    assert not far.attempted
    assert far.iterations == 0
    assert retry_within(far, START_WITHIN) == START_WITHIN
    close = shoot_from(p, 8, start_within=START_WITHIN, max_iterations=1)
    assert not close.converged
    assert close.attempted
    assert retry_within(close, START_WITHIN) == pytest.approx(0.5 * close.residuals[0])


def test_a_limit_on_iterations_is_kept(paper):
    p = plan(paper, tolerance=1e-10)
    shot = shoot_from(p, 5, max_iterations=2)
    assert not shot.converged
    assert shot.iterations == 2
    assert shot.residuals[-1] < shot.residuals[0]


def test_a_plan_without_its_problem_is_refused(paper):
    with pytest.raises(ValueError, match="does not know its problem"):
        shoot_from(plan(paper).replace(problem=None))
