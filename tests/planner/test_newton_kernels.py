"""Kernels of a problem's equations: its functions' values, their derivatives, the model's step.

Each by machine code, by NumPy code of the trace, and by the problem's own functions where those
cannot be traced.
"""

import dataclasses
import importlib.util
import threading
from pathlib import Path

import numpy as np
import pytest
import scipy.interpolate

from slipcar.envs import Scenario
from slipcar.planner import plan
from slipcar.planner.newton import posing
from slipcar.planner.newton.equations import KNOBS, Evaluation, Form, Model, Promise
from slipcar.planner.newton.posing import pose
from slipcar.planner.newton.program import Workspace
from slipcar.planner.newton.quantities import Traced
from slipcar.planner.newton.running import load
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.model import model_of
from slipcar.planner.trace import machine_code

needs_llvm = pytest.mark.skipif(not machine_code.available(), reason="needs llvmlite")
NATIVE = [
    pytest.param(False, id="numpy"),
    pytest.param(True, id="machine code", marks=needs_llvm),
]


def _boat():
    path = Path(__file__).parents[2] / "examples" / "boat.py"
    spec = importlib.util.spec_from_file_location("boat_example", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Boat()


class Glider:
    """A point in a gusty wind that changes with time; every kind of cost.

    Three states, two controls, four Brownian motions; one non-linear terminal condition.
    """

    start = np.array([0.3, -0.2, 1.1])
    times = np.linspace(0.0, 2.0, 12) ** 1.3
    control_weight = np.array([[2.0, 0.3], [0.3, 1.0]])
    penalty_weight = np.array([3.0, 7.0])
    gust = 0.4

    def drift(self, t, x, u):
        wind = np.sin(3.0 * t) * np.exp(-t)
        first = x[..., 2] * np.cos(x[..., 1]) + wind
        second = u[..., 0] + self.gust * x[..., 2] ** 2
        third = u[..., 1] * (1.0 + np.tanh(x[..., 1])) - 0.1 * np.sqrt(4.0 + x[..., 2] ** 2) * wind
        return np.stack([first, second, third], axis=-1)

    def diffusion(self, t, x):
        sigma = np.zeros((*x.shape, 4), dtype=x.dtype)
        sigma[..., 0, 0] = 0.1 * t
        sigma[..., 0, 1] = 0.2 * x[..., 1]
        sigma[..., 0, 3] = 0.1 * x[..., 2] * x[..., 1]
        return sigma

    def terminal(self, x):
        return (x[..., 0] ** 2 + np.sin(x[..., 1]) - 1.0)[..., None]

    def penalty(self, t, x):
        return np.stack([x[..., 0] * x[..., 2] - 0.2, np.cos(x[..., 1]) - 0.9 - 0.1 * t], axis=-1)

    def state_cost(self, t, x):
        return np.cos(x[..., 0]) * (1.0 + t) + x[..., 1] ** 2 * x[..., 2] ** 2

    def control_cost(self, t, x):
        return np.stack([x[..., 0] * x[..., 1], np.sin(t) * x[..., 2] ** 3], axis=-1)


def _opaque(values):
    """The same numbers through code that leaves NumPy; expressions do not pass."""
    flat = [float(value) for value in np.ravel(values)]
    return np.array(flat).reshape(np.shape(values))


class OpaqueGlider(Glider):
    """The same, but what its functions do cannot be traced."""

    def drift(self, t, x, u):
        return super().drift(t, _opaque(x), u)


CASES = {
    "paper": model_of(Scenario.named("paper")),
    "no obstacles": model_of(Scenario.random(1, 0, turned=True)),
    "eight obstacles": model_of(Scenario.random(8, 8, turned=True)),
    "boat": model_of(_boat()),
    "glider": model_of(Glider()),
    "glider, rk4": dataclasses.replace(model_of(Glider()), integrator="rk4"),
    "paper, rk4": dataclasses.replace(model_of(Scenario.named("paper")), integrator="rk4"),
    "opaque glider": model_of(OpaqueGlider()),
    "opaque glider, rk4": dataclasses.replace(model_of(OpaqueGlider()), integrator="rk4"),
}


class Loaded:
    """A workspace at a random point with random multipliers, and what is done with it."""

    def __init__(self, model, native, seed=0, form=None):
        rng = np.random.default_rng(seed)
        self.model, self.K = model, len(model.dt)
        self.posed = pose(model, compiled=None if native else False)
        self.ws = Workspace(self.posed.program(form or Form()), self.K)
        n, m = model.state_dim, model.control_dim
        self.x = model.start + 0.5 * rng.normal(size=(self.K + 1, n))
        self.u = rng.normal(size=(self.K, m))
        load(self.ws, self.posed, model.weight, self.x, self.u)
        # Bounds are of no concern here.
        self.ws.arrays["lower"][:], self.ws.arrays["upper"][:] = -np.inf, np.inf
        for name in ("lam", "nu"):
            self.at(name)[:] = rng.normal(size=self.at(name).shape)

    def at(self, name):
        return self.ws.at(0, name)

    def set(self, **knobs):
        for name, value in knobs.items():
            self.ws.arrays["knob"][0, KNOBS.index(name)] = value

    def run(self, kernel):
        self.ws.kernels[kernel][0]()

    def bend(self):
        """Second derivatives of a problem that is filled in."""
        if self.posed.filler is not None:
            self.posed.filler.second(self.ws, 0)

    def evaluate(self):
        if self.posed.filler is not None:
            self.posed.filler.point(self.ws, 0)
        self.run("evaluate")
        return Evaluation._make(self.ws.view("evaluated"))

    def moved(self, d, e):
        """The Lagrangian, and all that is said of a point, at x + d, u + e."""
        self.at("x")[:], self.at("u")[: self.K] = self.x + d, self.u + e
        at = self.evaluate()
        return at.effort + at.running + at.charged + at.pull

    def quadratic(self):
        """Solve the model at the point; what it says."""
        self.evaluate()
        self.bend()
        self.at("H_psd")[:] = self.at("H_xx")
        self.run("backward")
        return Model._make(self.ws.view("modelled"))

    def forward(self):
        self.run("forward")
        return Promise._make(self.ws.view("promised"))


@pytest.fixture(params=CASES)
def case(request):
    return CASES[request.param]


def _close(got, known, rtol=1e-12):
    scale = 1.0 + np.abs(known).max(initial=0.0)
    np.testing.assert_allclose(got, known, rtol=0.0, atol=rtol * scale)


# ---------------------------------------------------------------------------- values and slopes


def _step(model, x, u):
    return x + change(model.integrator, model.problem.drift, model.times[:-1], model.dt, x, u)


@pytest.mark.parametrize("native", NATIVE)
def test_values_are_those_of_the_problems_functions(case, native):
    at, problem = Loaded(case, native), case.problem
    root = np.random.default_rng(3).normal(size=(case.state_dim, case.state_dim))
    price = root @ root.T
    at.ws.arrays["price"][0] = price.ravel()
    said = at.evaluate()
    x, u, t, dt, K = at.x, at.u, case.times, case.dt, at.K
    f = _step(case, x[:-1], u) - x[1:]
    _close(at.at("f")[:K], f)
    _close(at.at("g")[0], problem.terminal(x[K]))
    effort = sum(h * v @ case.R @ v for h, v in zip(dt, u, strict=True))
    assert said.effort == pytest.approx(effort)
    running = 0.0
    if case.has("state_cost"):
        running += dt @ problem.state_cost(t[1:], x[1:])
        running += np.sum(dt * np.sum(problem.control_cost(t[:-1], x[:-1]) * u, axis=-1))
    assert said.running == pytest.approx(running, abs=1e-12)
    penalty = 0.0
    if len(case.weight):
        c = problem.penalty(t, x)
        _close(at.at("c"), c)
        penalty = dt @ (np.maximum(c[1:], 0.0) ** 2 @ case.weight)
        assert penalty > 0.0 or case is CASES["boat"]  # whose pier is far away
    assert said.penalty == pytest.approx(penalty)
    assert said.charged == pytest.approx(penalty)
    lam, nu, g = at.at("lam"), at.at("nu")[0], problem.terminal(x[K])
    assert said.pull == pytest.approx(np.vdot(lam[1:], f) + nu @ g)
    charges = np.abs(np.sum(lam[1:] * f, axis=1))
    assert said.gap == pytest.approx(
        np.sum(charges + np.sqrt(np.einsum("ki,ij,kj->k", f, price, f)))
    )
    assert said.miss == pytest.approx(np.abs(nu * g).sum())
    assert said.defect == pytest.approx(np.abs(f).max())
    assert said.residual == pytest.approx(np.abs(g).max())


def _differences(f, x):
    """∂f/∂x of f (N, n) -> (N, ...), by central differences of order four."""
    h, columns = 1e-3, []
    for i in range(x.shape[1]):
        step = np.zeros(x.shape[1])
        step[i] = h
        near, far = (np.asarray(f(x + s * step)) - f(x - s * step) for s in (1, 2))
        columns.append((8.0 * near - far) / (12.0 * h))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("native", NATIVE)
def test_jacobians_are_those_of_differences(case, native):
    at, problem = Loaded(case, native), case.problem
    at.evaluate()
    x, u, t, K = at.x, at.u, case.times, at.K
    _close(at.at("A")[:K], _differences(lambda y: _step(case, y, u), x[:-1]), 1e-8)
    _close(at.at("B")[:K], _differences(lambda v: _step(case, x[:-1], v), u), 1e-8)
    _close(at.at("G"), _differences(problem.terminal, x[K:]), 1e-8)
    if len(case.weight):
        _close(at.at("C"), _differences(lambda y: problem.penalty(t, y), x), 1e-8)
    if case.has("state_cost"):
        gradient = lambda y: _differences(lambda z: problem.state_cost(t, z), y)  # noqa: E731
        _close(at.at("H_xx"), _differences(gradient, x), 1e-6)


def test_an_opaque_problem_is_filled_in_and_the_others_are_traced(case):
    posed = pose(case)
    opaque = isinstance(case.problem, OpaqueGlider)
    assert isinstance(posed.problem, Traced) == (not opaque)
    assert ("float()" in posed.reason) == opaque


# ---------------------------------------------------------------------------- the quadratic model


def _directions(at, seed):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=at.x.shape)
    d[0] = 0.0
    return d, rng.normal(size=at.u.shape)


def _hinges(at):
    """Slopes and curvatures of the penalties at nodes, which the arrays leave out."""
    c, C = at.at("c"), at.at("C")
    w = at.model.weight * np.append(0.0, at.model.dt)[:, None]
    slope = np.einsum("kp,kpi->ki", 2.0 * w * np.maximum(c, 0.0), C)
    return slope, np.einsum("kp,kpi,kpj->kij", 2.0 * w * (c > 0.0), C, C)


@pytest.mark.parametrize("native", NATIVE)
def test_the_model_is_the_lagrangians_expansion_to_second_order(case, native):
    at = Loaded(case, native)
    K = at.K
    at.set(hinges=1.0, curved=1.0)
    said = at.quadratic()
    assert said.charged == pytest.approx(at.evaluate().charged)
    slope, bend = _hinges(at)
    Q, q = at.at("Q") + bend, at.at("q") + slope
    R, r, S = at.at("Rk")[:K], at.at("rk")[:K], at.at("S")[:K]
    A, B, G, lam, nu = (at.at(name).copy() for name in ("A", "B", "G", "lam", "nu"))
    _close(Q, Q.swapaxes(1, 2), 1e-9)
    for seed in range(4):
        d, e = _directions(at, seed)
        moved = np.einsum("kij,kj->ki", A[:K], d[:K]) + np.einsum("kij,kj->ki", B[:K], e) - d[1:]
        first = np.vdot(q, d) + np.vdot(r, e) + np.vdot(lam[1:], moved) + nu[0] @ G[0] @ d[K]
        second = np.einsum("ki,kij,kj", d, Q, d) + np.einsum("ki,kij,kj", e, R, e)
        second += 2.0 * np.einsum("ki,kij,kj", e, S, d[:K])
        h = 1e-3
        L = {s: at.moved(s * h * d, s * h * e) for s in (-2, -1, 0, 1, 2)}
        slope_of = (8.0 * (L[1] - L[-1]) - (L[2] - L[-2])) / (12.0 * h)
        bend_of = (16.0 * (L[1] + L[-1]) - (L[2] + L[-2]) - 30.0 * L[0]) / (12.0 * h * h)
        size = np.abs([first, second, L[0]]).max()
        assert first == pytest.approx(slope_of, abs=1e-6 * size)
        # Where a hinge is within the step, its kink is.
        assert second == pytest.approx(bend_of, abs=2e-4 * size)


@pytest.mark.parametrize("native", NATIVE)
def test_without_curvature_it_is_the_costs_alone(case, native):
    at = Loaded(case, native)
    K, n = at.K, case.state_dim
    at.set(hinges=1.0, curved=0.0)
    at.quadratic()
    if not case.has("state_cost"):
        _close(at.at("Q"), np.zeros((K + 1, n, n)))
    _close(at.at("Rk")[:K], 2.0 * case.dt[:, None, None] * case.R)
    if not case.has("control_cost"):
        _close(at.at("S")[:K], 0.0 * at.at("S")[:K])


@pytest.mark.parametrize("native", NATIVE)
def test_the_step_satisfies_the_models_optimality_conditions(case, native):
    at = Loaded(case, native)
    K, damping = at.K, 5.0
    at.set(hinges=1.0, curved=1.0, damping=damping)
    assert at.quadratic().bad >= 0.0
    while at.quadratic().bad > 0.0:
        damping *= 4.0
        at.set(damping=damping)
    promise = at.forward()
    slope, bend = _hinges(at)
    Q, q = at.at("Q") + bend, at.at("q") + slope
    Q[0], q[0] = 0.0, 0.0  # the start does not move
    S, r = at.at("S")[:K], at.at("rk")[:K]
    R = at.at("Rk")[:K] + 2.0 * damping * case.dt[:, None, None] * case.R
    A, B, f = at.at("A")[:K], at.at("B")[:K], at.at("f")[:K]
    d, e = at.at("d"), at.at("e")[:K]
    lam, nu = at.ws.at(0, "lam_new"), at.ws.at(0, "nu_new")[0]
    assert promise.total == pytest.approx(lam[1:].sum())
    assert (d[0] == 0.0).all()
    ahead = np.einsum("kij,kj->ki", A, d[:K]) + np.einsum("kij,kj->ki", B, e) + f
    _close(d[1:], ahead, 1e-9)
    _close(at.at("G")[0] @ d[K] + at.at("g")[0], 0.0 * nu, 1e-7)
    by_control = np.einsum("kij,kj->ki", R, e) + r + np.einsum("kij,kj->ki", S, d[:K])
    by_control += np.einsum("kji,kj->ki", B, lam[1:])
    size = np.abs(lam).max() + np.abs(q).max()
    np.testing.assert_allclose(by_control, 0.0, atol=1e-8 * size)
    by_state = np.einsum("kij,kj->ki", Q, d) + q
    by_state[:K] += np.einsum("kji,kj->ki", S, e)
    by_state[:K] += np.einsum("kji,kj->ki", A, lam[1:])
    by_state[K] += at.at("G")[0].T @ nu
    np.testing.assert_allclose(lam[1:], by_state[1:], atol=1e-8 * size)
    # What it promises, hinges with their kink.
    c, C = at.at("c"), at.at("C")
    w = case.weight * np.append(0.0, case.dt)[:, None]
    after = np.maximum(c + np.einsum("kpi,ki->kp", C, d), 0.0)
    change = np.sum(w * (after**2 - np.maximum(c, 0.0) ** 2))
    change += 0.5 * np.einsum("ki,kij,kj", d, at.at("Q"), d) + np.vdot(at.at("q"), d)
    change += 0.5 * np.einsum("ki,kij,kj", e, at.at("Rk")[:K], e) + np.vdot(r, e)
    change += np.einsum("ki,kij,kj", e, S, d[:K])
    assert promise.change == pytest.approx(change, rel=1e-8)
    assert promise.step == pytest.approx(case.dt @ (e * e).sum(axis=1))
    assert promise.length == pytest.approx(np.einsum("k,ki,ij,kj", case.dt, e, case.R, e))
    assert promise.radius == pytest.approx(case.dt @ (d[1:] ** 2).sum(axis=1))
    along = np.vdot(at.at("q") + slope, d) + np.vdot(r, e)
    assert promise.slope == pytest.approx(along, abs=1e-9 * (1.0 + np.abs(q).max()))


@pytest.mark.parametrize("native", NATIVE)
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_bounds_that_are_held_are_reached_and_those_that_are_passed_are_said(native, side):
    case = CASES["boat"]
    at = Loaded(case, native)
    at.set(hinges=1.0, damping=10.0, stiffness=1e12)
    at.ws.arrays["lower"][:], at.ws.arrays["upper"][:] = -1.5, 1.5
    at.u[:] = np.clip(at.u, -1.5, 1.5)
    at.at("u")[: at.K] = at.u
    sign = {"lower": -1.0, "upper": 1.0}[side]
    at.ws.arrays["held"][3, 1] = sign
    assert at.quadratic().bad == 0.0
    promise = at.forward()
    assert at.u[3, 1] + at.at("e")[3, 1] == pytest.approx(1.5 * sign, abs=1e-8)
    e = at.at("e")[: at.K]
    assert (np.abs(at.u + e) <= 1.5 + 1e-12).all()
    at.ws.arrays["lower"][:], at.ws.arrays["upper"][:] = -np.inf, np.inf
    at.forward()
    free = at.u + at.at("e")[: at.K]
    passed = 1.0 * (free > 1.5) - 1.0 * (free < -1.5)
    held = at.ws.arrays["held"][: at.K]
    passed[3, 1] = held[3, 1]  # on the bound but for rounding
    at.ws.arrays["lower"][:], at.ws.arrays["upper"][:] = -1.5 - 1e-9, 1.5 + 1e-9
    promise = at.forward()
    got = at.ws.arrays["passed"][: at.K].copy()
    got[3, 1] = held[3, 1]
    np.testing.assert_array_equal(got, passed)
    assert promise.changed >= np.abs(passed - held).sum() > 0.0


@pytest.mark.parametrize("native", NATIVE)
@pytest.mark.parametrize("name", [name for name, c in CASES.items() if not c.has("state_cost")])
def test_reach_is_how_far_the_last_controls_of_unit_cost_move_each_end(name, native):
    case = CASES[name]
    at = Loaded(case, native)
    at.set(hinges=0.0, curved=0.0)
    at.quadratic()
    A, B, Phi = at.at("A"), at.at("B"), at.at("G")[0]
    q, m = Phi.shape[0], case.control_dim
    total = np.zeros(q)
    for k in range(at.K - 1, max(at.K - 2 * -(-q // m) - 2, 0) - 1, -1):
        pushed = Phi @ B[k]
        total += np.diagonal(pushed @ np.linalg.inv(2.0 * case.dt[k] * case.R) @ pushed.T)
        Phi = Phi @ A[k]
    _close(at.ws.arrays["reach"][0], total, 1e-9)


@pytest.mark.parametrize("native", NATIVE)
@pytest.mark.parametrize("alpha", [1.0, 0.25])
def test_a_roll_out_keeps_a_part_of_the_defects_and_all_bounds(case, native, alpha):
    at = Loaded(case, native)
    at.set(hinges=1.0, curved=0.0, damping=50.0)
    at.ws.arrays["lower"][:], at.ws.arrays["upper"][:] = -2.0, 2.0
    at.u[:] = np.clip(at.u, -2.0, 2.0)
    at.at("u")[: at.K] = at.u
    at.quadratic()
    at.forward()
    at.set(alpha=alpha)
    if at.posed.filler is None:
        at.ws.kernels["rollout"][1]()
    else:
        at.posed.filler.rollout(at.ws, 1)
    x, u = at.ws.at(1, "x"), at.ws.at(1, "u")[: at.K]
    assert (np.abs(u) <= 2.0).all()
    kept = (1.0 - alpha) * (_step(case, at.x[:-1], at.u) - at.x[1:])
    np.testing.assert_array_equal(x[0], at.x[0])
    _close(_step(case, x[:-1], u) - x[1:], kept, 1e-9)


@pytest.mark.parametrize("native", NATIVE)
def test_the_covariance_is_that_of_the_linearised_system(case, native):
    at = Loaded(case, native)
    at.evaluate()
    rng = np.random.default_rng(5)
    root = rng.normal(size=(case.state_dim, case.state_dim))
    at.ws.arrays["Sigma"][0] = (root @ root.T).ravel()
    at.run("spread")
    S, t, dt = root @ root.T, case.times, case.dt
    sigma = np.asarray(case.problem.diffusion(t, at.x))
    d_sigma = _differences(lambda y: case.problem.diffusion(t, y), at.x)
    for k in range(at.K):
        noise = sigma[k] @ sigma[k].T + np.einsum("iaj,jl,kal->ik", d_sigma[k], S, d_sigma[k])
        S = at.at("A")[k] @ S @ at.at("A")[k].T + dt[k] * noise
        _close(at.at("Sigma")[k + 1], S, 1e-8)


#: Arrays whose last row belongs to no interval.
STAGES = {"A", "B", "f", "u", "e", "law", "Rk", "rk", "S", "passed", "held", "gains"}


@needs_llvm
def test_machine_code_and_numpy_agree_to_rounding(case):
    for form in (Form(), Form(noisy=True), Form(noisy=True, soft=True)):
        native, plain = (Loaded(case, n, 1, form) for n in (True, False))
        for at in (native, plain):
            at.set(hinges=1.0, curved=1.0, damping=30.0, variance_weight=2.0, closed=1.0)
            at.set(alpha=0.5)
            if form.noisy:
                at.ws.arrays["W"][:] = 3.0
                at.ws.arrays["box_lower"][:], at.ws.arrays["box_upper"][:] = -9.0, 9.0
            at.evaluate()
            at.bend()
            for kernel in ("spread", *(("stakes",) if form.noisy else ()), "weights"):
                at.run(kernel)
            for damping in 30.0 * 10.0 ** np.arange(9):  # until the model is convex
                at.set(damping=damping)
                if at.quadratic().bad == 0.0:
                    break
            at.forward()
            at.run("shift")
        for name, field in native.ws.program.layout.items():
            if name in plain.ws.arrays:
                a, b = (at.ws.arrays[name] for at in (native, plain))
                if name.removesuffix("_new") in STAGES:
                    a, b = a[:-1], b[:-1]
                scale = 1.0 + np.abs(b[np.isfinite(b)]).max(initial=0.0)
                limit = 1e-9 if name in ("V", "law", "lam_new", "nu_new", "modelled") else 1e-10
                np.testing.assert_allclose(a, b, rtol=limit, atol=limit * scale, err_msg=name)
                assert a.shape[1] == field.width


@pytest.mark.parametrize("native", NATIVE)
def test_expectations_of_rows_are_those_of_their_second_order_model(native):
    case = CASES["glider"]
    posed = pose(case, compiled=None if native else False)
    opaque = pose(CASES["opaque glider"])
    rng = np.random.default_rng(2)
    x = rng.normal(size=(12, 3))
    root = 0.3 * rng.normal(size=(12, 3, 3))
    S = root @ root.swapaxes(1, 2)
    t, penalty = case.times, case.problem.penalty
    C = _differences(lambda y: penalty(t, y), x)
    bend = _differences(lambda y: _differences(lambda z: penalty(t, z), y), x)
    mean = penalty(t, x) + 0.5 * np.einsum("kpij,kij->kp", bend, S)
    s = np.sqrt(np.einsum("kpi,kij,kpj->kp", C, S, C))
    s = np.maximum(s, 0.02 * s[1:].max(axis=0))
    for given in (posed, opaque):
        got = given.row_moments(x, S)
        np.testing.assert_allclose(got[0], mean[1:], atol=1e-6)
        np.testing.assert_allclose(got[1], s[1:], atol=1e-7)


# ------------------------------------------------------------------------------------ one kind


@pytest.fixture
def no_compiler(monkeypatch):
    """Code that is not known yet is an error."""

    def refuse(*args, **kwargs):
        raise AssertionError("compiled anew")

    monkeypatch.setattr(machine_code, "code", refuse)


def _agree_with_functions(posed):
    """The quantities of a trace against the problem's functions, at random points."""
    model, rng = posed.model, np.random.default_rng(3)
    K = len(model.dt)
    x = model.start + rng.normal(size=(K, model.state_dim))
    u = rng.normal(size=(K, model.control_dim))
    got = posed.problem.values(model.times[:-1], model.dt[0], x, u, posed.numbers)
    none = np.zeros((K, model.control_dim + 1))  # these have neither ℓ nor H
    parts = [_step(model, x, u), model.diffusion(model.times[:-1], x).reshape(K, -1), none[:, 1:]]
    if len(model.weight):
        parts.append(model.penalty(model.times[:-1], x))
    parts += [none[:, :1], model.terminal(x)]
    _close(got, np.concatenate(parts, axis=1))


@needs_llvm
def test_one_program_serves_all_worlds_with_as_many_obstacles(request):
    first = pose(model_of(Scenario.random(11, 3)))
    program = first.program(Form())
    request.getfixturevalue("no_compiler")
    for seed in (12, 13):
        world = Scenario.random(seed, 3, turned=True, clearance=0.2, slip=(0.3, 0.02))
        posed = pose(model_of(world))
        assert posed.program(Form()) is program
        assert posed.structure == first.structure
        _agree_with_functions(posed)


def test_worlds_with_another_number_of_obstacles_or_integrator_are_another_structure():
    three, four = (model_of(Scenario.random(5, k)) for k in (3, 4))
    rk4 = dataclasses.replace(three, integrator="rk4")
    posed = [pose(model) for model in (three, four, rk4)]
    assert len({p.structure for p in posed}) == 3
    assert posed[0].structure == pose(model_of(Scenario.random(6, 3))).structure
    for p in posed:
        _agree_with_functions(p)


def test_a_kind_that_names_its_numbers_is_traced_once(monkeypatch):
    pose(model_of(Scenario.random(21, 2)))

    def refuse(*args):
        raise AssertionError("traced anew")

    monkeypatch.setattr(posing, "trace_call", refuse)
    _agree_with_functions(pose(model_of(Scenario.random(22, 2, clearance=0.3))))


class Cart:
    """Position and speed [m, m/s], with drag; a plain class, which can be changed."""

    start = np.array([0.0, 1.0])
    times = np.linspace(0.0, 1.0, 9)
    control_weight = np.eye(1)
    goal = np.array([1.0, 0.0])

    def __init__(self, drag=0.3):
        self.drag = drag

    def drift(self, t, x, u):
        v = x[..., 1]
        return np.stack([v, u[..., 0] - self.drag * v**3], axis=-1)

    def diffusion(self, t, x):
        return np.zeros((*x.shape, 1), dtype=x.dtype)

    def terminal(self, x):
        return x - self.goal


@needs_llvm
@pytest.mark.parametrize("change", [0.31, 0.3 + 1e-12, -5.0, 1e30])
def test_numbers_are_read_anew_in_every_call_and_compiled_never(change, request):
    cart = Cart()
    before = pose(model_of(cart))
    program = before.program(Form())
    request.getfixturevalue("no_compiler")
    cart.drag = change
    after = pose(model_of(cart))
    assert after.program(Form()) is program
    assert (after.numbers != before.numbers).any()
    _agree_with_functions(after)
    _agree_with_functions(pose(model_of(Cart(0.7))))


@pytest.mark.parametrize("special", [0.0, 1.0, -1.0])
def test_numbers_that_simplify_the_structure_do_so(special):
    cart = Cart()
    before = pose(model_of(cart))
    cart.drag = special
    after = pose(model_of(cart))
    assert after.structure != before.structure
    _agree_with_functions(after)


def test_mutated_arrays_are_read_anew():
    cart = Cart()
    cart.goal = np.array([1.5, 0.0])
    first = pose(model_of(cart))
    cart.goal[0] = 2.5
    _agree_with_functions(pose(model_of(cart)))
    assert 1.5 in first.numbers


def test_functions_that_are_replaced_are_another_structure():
    cart = Cart()
    first = pose(model_of(cart))
    cart.drift = lambda t, x, u: np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0])], axis=-1)
    second = pose(model_of(cart))
    assert second.structure != first.structure
    _agree_with_functions(second)
    del cart.drift
    assert pose(model_of(cart)).structure == first.structure


def test_a_change_in_small_units_is_noticed_beside_large_ones():
    class Slow(Cart):
        start = np.array([0.0, 1.0, 4e7])  # and a height in metres

        def drift(self, t, x, u):
            slow = 1e-6 * self.drag * x[..., 1]
            return np.stack([x[..., 1] + slow, u[..., 0], 1e7 * x[..., 1]], axis=-1)

        def terminal(self, x):
            return x[..., :2] - self.goal

        def parameters(self):  # all but the drag
            return {"goal": self.goal}

        def with_parameters(self, parameters):
            copy = Slow(self.drag)
            copy.goal = parameters["goal"]
            return copy

    slow = Slow(drag=2.0)
    pose(model_of(slow))
    slow.drag = 3.0
    posed = pose(model_of(slow))
    x = np.array([[0.2, 3.0, 0.0]])
    got = posed.problem.values(np.zeros(1), 1.0, x, np.zeros((1, 1)), posed.numbers)
    assert got[0, 0] - 3.2 == pytest.approx(9e-6, rel=1e-6)


class Forgetful(Cart):
    """Names its drag among its numbers, but not its mass."""

    mass = 1.0

    def drift(self, t, x, u):
        return super().drift(t, x, u / self.mass)

    def parameters(self):
        return {"drag": np.asarray(self.drag)}

    def with_parameters(self, parameters):
        copy = object.__new__(Forgetful)
        vars(copy).update({**vars(self), **parameters})
        return copy


def test_problems_of_one_class_that_name_too_little_do_not_get_each_others_numbers():
    light, heavy = Forgetful(), Forgetful(0.7)
    heavy.mass = 3.0
    for problem in (light, heavy, light, heavy):
        _agree_with_functions(pose(model_of(problem)))


def test_threads_may_pose_problems_of_one_kind():
    wrong = []

    def work(seed):
        try:
            for k in range(10):
                problem = Forgetful(0.1 * seed)
                problem.mass = 1.0 + (seed + k) % 5
                _agree_with_functions(pose(model_of(problem)))
        except BaseException as error:
            wrong.append(error)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


# ------------------------------------------------------------------------------- no wrong trace


class ByType(Cart):
    def drift(self, t, x, u):
        honest = super().drift(t, x, u)
        return honest if x.dtype == object else 1.5 * honest


class ByInstance(Cart):
    def drift(self, t, x, u):
        number = isinstance(x.reshape(-1)[0], float)
        return super().drift(t, x, u) * (2.0 if number else 1.0)


class Tries(Cart):
    def drift(self, t, x, u):
        try:
            factor = 1.0 + np.round(np.asarray(x.real, dtype=float)[..., :1])
        except TypeError:
            factor = 1.0
        return super().drift(t, x, u) * factor


class Pushed(Cart):
    def drift(self, t, x, u):
        return super().drift(t, x, u) + 0.123


class Random(Cart):
    rng = np.random.default_rng(0)

    def drift(self, t, x, u):
        return super().drift(t, x, u) + self.rng.normal()


class Counts(Cart):
    calls = 0

    def drift(self, t, x, u):
        self.calls += 1
        return super().drift(t, x, u) + 1e-3 * self.calls


class Repr(Cart):
    def drift(self, t, x, u):
        return super().drift(t, x, u) * len(str(x.reshape(-1)[0]))


class Filtered(Cart):
    def drift(self, t, x, u):
        return super().drift(t, x, u) + np.nan_to_num(np.sqrt(x[..., :1] * x[..., 1:] - 0.2))


@pytest.mark.parametrize("kind", [ByType, ByInstance, Tries, Random, Counts, Repr, Filtered])
def test_traces_that_tell_another_story_are_not_used(kind, rollout):
    # Either the plan follows what the functions say, or it is refused; also where the structure
    # is known of an honest problem.
    plan(Pushed(), variance_weight=0.0)
    problem = kind()
    try:
        p = plan(problem, variance_weight=0.0, tolerance=1e-10)
    except ValueError:
        return
    np.testing.assert_allclose(p.mean, rollout(problem, p.controls), atol=1e-6)


class WritesInItsArgument(Cart):
    def drift(self, t, x, u):
        if x.dtype == object:
            x *= 2.0
        return super().drift(t, x, u)


class Branches(Cart):
    def drift(self, t, x, u):
        v = x[..., 1] if np.all(x[..., 0] < 9.0) else 0.0 * x[..., 1]
        return np.stack([v, u[..., 0] - self.drag * v**3], axis=-1)


@pytest.mark.parametrize(
    ("kind", "what"), [(WritesInItsArgument, "wrote into its argument"), (Branches, "a branch")]
)
def test_code_that_cannot_be_traced_though_it_could_is_refused_by_name_and_line(kind, what):
    for compiled in (None, False):
        with pytest.raises(ValueError, match=rf"drift.*{what}.*test_newton_kernels\.py:\d+"):
            pose(model_of(kind()), compiled=compiled)


def test_with_its_derivative_it_is_taken_as_it_is():
    class Given(Branches):
        def drift_jacobian(self, t, x, u):
            A = np.zeros((*x.shape, 2))
            A[..., 0, 1], A[..., 1, 1] = 1.0, -3.0 * self.drag * x[..., 1] ** 2
            return A, np.broadcast_to([[0.0], [1.0]], (*x.shape, 1))

    native, plain = (plan(kind(), variance_weight=0.0, tolerance=1e-12) for kind in (Given, Cart))
    np.testing.assert_allclose(native.controls, plain.controls, atol=1e-6)


@needs_llvm
def test_machine_code_that_is_insisted_on_says_why_there_is_none():
    class Spline(Cart):
        table = scipy.interpolate.CubicSpline([-9.0, 0.0, 9.0], [0.0, 1.0, 0.0])

        def drift(self, t, x, u):
            return super().drift(t, x, u) + 0.1 * self.table(x)

    with pytest.raises(ValueError, match=r"functions of Spline cannot be compiled: drift.*table"):
        pose(model_of(Spline()), compiled=True)
    assert pose(model_of(Spline())).reason
