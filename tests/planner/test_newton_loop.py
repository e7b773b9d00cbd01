"""Newton's iteration: its answers are extremals and known optima, whatever evaluates the problem.

By machine code, by NumPy code of the trace, and by the problem's own functions where a trace is
refused.
"""

import dataclasses
import itertools
import time

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan, plan_batch
from slipcar.planner.extremal.certificate import violations
from slipcar.planner.newton.posing import pose
from slipcar.planner.newton.running import solve_mean
from slipcar.planner.options import Options
from slipcar.planner.problem.model import model_of
from slipcar.planner.trace import machine_code

#: Kernels as machine code, kernels and quantities in NumPy, quantities by the problem's functions.
PATHS = ["numpy", "functions", *(["machine code"] if machine_code.available() else [])]


class Opaque:
    """A problem whose drift is code that leaves NumPy: expressions do not pass."""

    def __init__(self, problem):
        self._problem = problem

    def __getattr__(self, name):
        if name in ("parameters", "with_parameters"):
            raise AttributeError(name)
        return getattr(self._problem, name)

    def drift(self, t, x, u):
        x = np.array([float(value) for value in np.ravel(x)]).reshape(np.shape(x))
        return self._problem.drift(t, x, u)


def _solve(path, model, *, guess=None, free_first=False, history=True, **options):
    x, u = model.guess() if guess is None else guess
    given = Options(**{"tolerance": 1e-6, "integrator": model.integrator, **options})
    if path == "functions":
        model = dataclasses.replace(model, problem=Opaque(model.problem))
    posed = pose(model, compiled=False if path == "numpy" else None)
    assert bool(posed.reason) == (path == "functions")
    return solve_mean(posed, given, x, u, free_first=free_first, history=history)


def _all_agree(model, *, atol=1e-8, **options):
    """Solve by every path; the answer of the last."""
    found = [_solve(path, model, **options) for path in PATHS]
    for path, one in zip(PATHS, found, strict=True):
        assert one.status is found[0].status, path
        assert len(one.history) == one.iterations, path
        # Second derivatives by differences may take steps more to the last digits.
        extra = 2 if path == "functions" else 0
        assert 0 <= one.iterations - found[0].iterations <= extra, path
        for name in ("u", "x", "covariance", "A", "B"):
            a, b = getattr(one, name), getattr(found[0], name)
            np.testing.assert_allclose(a, b, atol=atol * (1.0 + np.abs(b).max()), err_msg=path)
        for name in ("adjoint", "terminal"):
            a, b = getattr(one, name), getattr(found[0], name)
            scale = 1.0 + np.abs(b).max(initial=0.0)
            np.testing.assert_allclose(a, b, atol=10 * atol * scale, err_msg=path)
        for name in ("effort", "penalty", "running", "objective"):
            known = getattr(found[0], name)
            assert getattr(one, name) == pytest.approx(known, rel=1e-7, abs=1e-7), path
    return found[-1]


def _extremal(model, found, w, limit):
    residuals = violations(model, found.x, found.u, found.terminal, variance_weight=w)
    assert residuals.largest < limit, residuals.relative
    scale = 1.0 + np.abs(residuals.adjoint).max()
    np.testing.assert_allclose(found.adjoint, residuals.adjoint, atol=1e-6 * scale)


# ------------------------------------------------------------------------------ the car


@pytest.mark.parametrize("w", [0.0, 1.0, 10.0])
def test_all_paths_agree_on_the_paper_case(paper, w):
    for free_first in (False, True):
        found = _all_agree(model_of(paper), variance_weight=w, free_first=free_first)
        assert found.status is Status.CONVERGED


@pytest.mark.parametrize("seed", range(12))
def test_all_paths_agree_on_random_worlds(seed):
    w = (0.0, 1.0, 10.0)[seed % 3]
    model = model_of(Scenario.random(seed, turned=True))
    found = _all_agree(model, variance_weight=w, free_first=seed % 2 == 0)
    assert found.status is Status.CONVERGED


@pytest.mark.parametrize("path", PATHS)
def test_the_paper_case_has_the_references_answer(paper, reference, path):
    known = reference["clearance_0.13"]
    found = _solve(path, model_of(paper), variance_weight=0.0, tolerance=1e-10)
    np.testing.assert_allclose(found.u, known["control"], atol=1e-4)
    np.testing.assert_allclose(found.x, known["state"], atol=1e-4)
    total = known["effort"] + known["obstacle_cost"]
    assert found.effort + found.penalty == pytest.approx(total, rel=1e-6)
    assert found.objective == pytest.approx(total, rel=1e-6)
    np.testing.assert_allclose(np.abs(found.terminal), known["terminal_multiplier_abs"], rtol=1e-3)
    trace = np.einsum("k,kii", np.diff(paper.times), found.covariance[1:])
    assert trace == pytest.approx(known["covariance_trace_integral"], rel=1e-3)


@pytest.mark.parametrize("w", [0.0, 1.0, 10.0])
def test_converged_answers_satisfy_the_maximum_principle(paper, w):
    worlds = [paper, *(Scenario.random(seed, turned=True) for seed in range(100, 108))]
    for scenario in worlds:
        model = model_of(scenario)
        found = _solve(PATHS[-1], model, variance_weight=w, tolerance=1e-20)
        assert found.status is Status.CONVERGED
        # The variance penalty's share of A's sensitivity is held, as LOCP has it.
        _extremal(model, found, w, 1e-8)


def _errors_from_nearby(scenario, w):
    """Relative errors of the controls step by step, from near the answer."""
    model, rng = model_of(scenario), np.random.default_rng(0)
    exact = _solve(PATHS[-1], model, variance_weight=w, tolerance=1e-24)
    assert exact.status is Status.CONVERGED
    near = (
        exact.x + 3e-3 * rng.normal(size=exact.x.shape),
        exact.u + 3e-3 * rng.normal(size=exact.u.shape),
    )
    near[0][0] = model.start
    found = _solve(PATHS[-1], model, variance_weight=w, tolerance=1e-24, guess=near)
    # Until a shift acts, or rounding has the last word.
    free = itertools.takewhile(lambda h: h.accepted and h.trust_multiplier == 0.0, found.history)
    size = np.linalg.norm(exact.u)
    return [np.linalg.norm(h.controls - exact.u) / size for h in free]


def test_convergence_is_quadratic_where_no_shift_acts(paper):
    orders = []
    for scenario in [paper, *(Scenario.random(seed, turned=True) for seed in range(200, 212))]:
        errors = [e for e in _errors_from_nearby(scenario, 0.0) if e > 1e-13]
        assert len(errors) <= 6
        if len(errors) >= 3:
            a, b, c = np.log(errors[-3:])
            orders.append((c - b) / (b - a))
    assert len(orders) >= 5
    assert np.median(orders) == pytest.approx(2.0, abs=0.4)


def test_with_a_variance_penalty_each_step_gains_a_decimal_digit_at_least(paper):
    # The penalty's weights are held in each model (:mod:`..moments`), so it is not quadratic.
    for scenario in [paper, *(Scenario.random(seed, turned=True) for seed in range(200, 204))]:
        errors = _errors_from_nearby(scenario, 1.0)
        assert len(errors) >= 3
        assert all(b < max(0.1 * a, 1e-13) for a, b in itertools.pairwise(errors[1:]))


def test_active_control_bounds_give_the_optimum_of_the_convex_sub_problems(paper):
    pytest.importorskip("cvxpy")
    tight = paper.replace(control_bounds=(0.7, 1.3))
    model = model_of(tight)
    found = _all_agree(model, variance_weight=0.0, tolerance=1e-10)
    assert found.status is Status.CONVERGED
    limit = np.array([0.7, 1.3])
    on = np.abs(found.u) > limit - 1e-9
    assert (np.abs(found.u) <= limit).all()
    assert on.any(axis=0).all()
    known = plan(tight, variance_weight=0.0, solver="cvxpy", tolerance=1e-8)
    assert known.status is Status.CONVERGED
    np.testing.assert_allclose(found.u, known.controls, atol=2e-4)
    assert found.objective == pytest.approx(known.cost, rel=1e-6)
    _extremal(model, found, 0.0, 1e-7)


# ------------------------------------------------------------------------------ other problems


@dataclasses.dataclass
class Chain:
    """Masses on springs, linear and quadratic: d/dt (p, v) = (v, L p + u on the last one)."""

    masses: int = 1
    nodes: int = 11
    steered: bool = True
    cost: bool = False
    noise: float = 0.1
    control_bounds: np.ndarray | None = None

    control_weight = np.eye(1)

    @property
    def start(self):
        return np.linspace(1.0, 2.0, 2 * self.masses)

    @property
    def times(self):
        return np.linspace(0.0, 3.0, self.nodes)

    def drift(self, t, x, u):
        p, v = x[..., : self.masses], x[..., self.masses :]
        link = 2.0 * np.eye(self.masses) - np.eye(self.masses, k=1) - np.eye(self.masses, k=-1)
        push = np.zeros((1, self.masses))
        push[0, -1] = 1.0
        return np.concatenate([v, u @ push - 0.3 * p @ link], axis=-1)

    def diffusion(self, t, x):
        sigma = np.zeros((*x.shape, 1), dtype=x.dtype)
        sigma[..., 0, 0] = self.noise
        return sigma

    def terminal(self, x):
        return x[..., -1:] - 0.5 if self.steered else x[..., :0]

    def state_cost(self, t, x):
        return np.sum(x * x, axis=-1) if self.cost else 0.0 * x[..., 0]

    def dense(self):
        """The optimal controls by least squares over all of them: no recursion, no iteration."""
        N, n = self.nodes, 2 * self.masses
        t, dt = self.times, np.diff(self.times)

        def path(u):
            x = [self.start]
            for k in range(N - 1):
                x.append(x[-1] + dt[k] * self.drift(t[k], x[-1], u[k : k + 1]))
            return np.concatenate(x[1:])

        free = path(np.zeros(N - 1))
        M = np.stack([path(e) - free for e in np.eye(N - 1)], axis=1)
        weights = np.repeat(dt, n) if self.cost else np.zeros((N - 1) * n)
        H = 2.0 * (np.diag(dt) + M.T @ (weights[:, None] * M))
        g = 2.0 * M.T @ (weights * free)
        if not self.steered:
            return np.linalg.solve(H, -g)
        row = M[-1:]
        full = np.block([[H, row.T], [row, np.zeros((1, 1))]])
        return np.linalg.solve(full, np.append(-g, 0.5 - free[-1]))[: N - 1]


CHAINS = {
    "without a terminal condition": Chain(steered=False, cost=True),
    "nothing to do": Chain(steered=False, cost=False),
    "one interval": Chain(nodes=2, steered=True),
    "one interval, no terminal condition": Chain(nodes=2, steered=False, cost=True),
    "a terminal condition": Chain(masses=2, cost=True),
    "ten masses": Chain(masses=10, nodes=6, cost=True),
    "too large for generated code": Chain(masses=40, nodes=5, steered=False, cost=True),
}


@pytest.mark.parametrize("name", CHAINS)
@pytest.mark.parametrize("w", [0.0, 2.0])
def test_linear_quadratic_problems_have_the_answer_of_one_dense_system(name, w):
    # Additive noise: the variance penalty is a constant.
    chain = CHAINS[name]
    model = model_of(chain)
    found = _all_agree(model, variance_weight=w, tolerance=1e-16)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.u[:, 0], chain.dense(), atol=1e-9)
    # The second step starts at the answer and confirms it; the first may have been hinges' off.
    assert len(found.history) <= 3


class Leak:
    """One state, one control, time-dependent and non-linear, with every kind of cost."""

    start = np.array([1.5])
    times = np.linspace(0.0, 2.0, 15) ** 1.2
    control_weight = np.array([[0.7]])
    penalty_weight = np.array([3.0, 5.0])
    control_bounds = np.array([[-4.0], [2.0]])

    def drift(self, t, x, u):
        return -(x**3) / (1.0 + x * x) + u * (1.0 + 0.2 * np.sin(x)) + np.sin(t)[..., None]

    def diffusion(self, t, x):
        # Nothing of the state: a σ(x) here would be noise that depends on a noisy state.
        return (0.1 + 0.05 * np.cos(t))[..., None, None] * np.ones_like(x)[..., None]

    def terminal(self, x):
        return np.sin(x) + 0.3 * x

    def penalty(self, t, x):
        return np.concatenate([x - 0.9, -0.2 - x * np.cos(t)[..., None]], axis=-1)

    def state_cost(self, t, x):
        return 1.0 - np.cos(x[..., 0]) + 0.1 * t * x[..., 0] ** 4

    def control_cost(self, t, x):
        return 0.3 * x * np.sin(t)[..., None]


class FreeLeak(Leak):
    """Without penalties, bounds and terminal condition."""

    penalty = None
    control_bounds = None

    def terminal(self, x):
        return x[..., :0]


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("kind", [Leak, FreeLeak])
def test_one_state_one_control_with_every_cost_converges_to_an_extremal(kind, integrator):
    model = dataclasses.replace(model_of(kind()), integrator=integrator)
    for w in (0.0, 1.0):
        found = _all_agree(model, variance_weight=w, tolerance=1e-14)
        assert found.status is Status.CONVERGED
        _extremal(model, found, w, 1e-6)


def test_uneven_and_strided_arrays_are_read_as_they_are_meant(paper):
    # Kernels are handed addresses: what lies in memory otherwise must be copied first.

    class Strided(Leak):
        times = np.repeat(Leak.times, 2)[::2]
        control_weight = np.asfortranarray(Leak.control_weight)

    for path in PATHS:
        one, other = (
            _solve(path, model_of(kind()), variance_weight=1.0) for kind in (Leak, Strided)
        )
        np.testing.assert_array_equal(one.u, other.u)
    model = model_of(paper)
    x, u = model.guess()
    turned = np.asfortranarray(x), np.asfortranarray(u)
    for path in PATHS:
        found = _solve(path, model, guess=turned)
        np.testing.assert_array_equal(found.u, _solve(path, model).u)


# ------------------------------------------------------------------------------ how it ends


class Stuck(Chain):
    """Nothing that is steered reaches what the terminal condition asks for."""

    def drift(self, t, x, u):
        return super().drift(t, x, 0.0 * u)


class Edge(Leak):
    """A function that is not finite below x = 1.2: the first whole step lands there."""

    control_bounds = None
    where = "penalty"

    def _root(self, x):
        return np.sqrt(x - 1.2)

    def drift(self, t, x, u):
        return u + (self._root(x) if self.where == "drift" else 0.0 * x)

    def penalty(self, t, x):
        root = self._root(x) if self.where == "penalty" else 0.0 * x
        return np.concatenate([root - 30.0, 0.0 * x - 1.0], axis=-1)

    def terminal(self, x):
        return x - 0.1

    def state_cost(self, t, x):
        return 0.01 * (self._root(x) if self.where == "state_cost" else 0.0 * x)[..., 0]

    def control_cost(self, t, x):
        return 0.01 * (self._root(x) if self.where == "control_cost" else 0.0 * x)

    def diffusion(self, t, x):
        return (self._root(x) if self.where == "diffusion" else np.ones_like(x))[..., None]


@pytest.mark.parametrize("path", PATHS)
def test_an_end_that_nothing_moves_is_no_answer(path):
    found = _solve(path, model_of(Stuck()))
    assert found.status is Status.SOLVER_FAILED
    assert len(found.history) == 0


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("where", ["drift", "penalty", "state_cost", "control_cost", "diffusion"])
def test_steps_to_where_a_function_is_not_finite_are_never_taken(where):
    edge = Edge()
    edge.where = where
    model = model_of(edge)
    for path in PATHS:
        for w in (0.0, 1.0):
            found = _solve(path, model, variance_weight=w)
            assert found.status in {Status.SOLVER_FAILED, Status.STALLED}, path
            assert np.isfinite(found.x).all()
            assert np.isfinite(found.objective)
            assert all(np.isfinite(h.mean).all() for h in found.history if h.accepted)


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("where", ["drift", "penalty", "diffusion"])
def test_a_guess_where_a_function_is_not_finite_is_an_error_that_names_it(path, where):
    edge = Edge()
    edge.where = where
    model = model_of(edge)
    x, u = model.guess()
    x[3:] = 0.5
    with pytest.raises(ValueError, match=f"{where}.* is not finite along the guess"):
        _solve(path, model, guess=(x, u))


def test_contradictory_terminal_conditions_never_converge():
    class Torn(Chain):
        def terminal(self, x):
            end = x[..., -1:]
            return np.concatenate([end - 0.5, 2.0 * end - 3.0], axis=-1)

    for path in PATHS:
        found = _solve(path, model_of(Torn()), max_iterations=60)
        assert not found.status.ok


@pytest.mark.parametrize("path", PATHS)
def test_too_few_iterations_are_said_so(paper, path):
    found = _solve(path, model_of(paper), max_iterations=3)
    assert found.status is Status.MAX_ITERATIONS
    assert len(found.history) == 3


@pytest.mark.parametrize("path", PATHS)
def test_a_callback_stops_the_loop(paper, path):
    seen = []

    def callback(iteration):
        seen.append(iteration)
        return len(seen) == 2

    found = _solve(path, model_of(paper), callback=callback)
    assert found.status is Status.STOPPED
    assert len(found.history) == 2
    np.testing.assert_array_equal(found.u, seen[-1].controls)


# ------------------------------------------------------------------------------ history


@pytest.mark.parametrize("path", PATHS)
def test_the_steps_kept_change_nothing_else(paper, path):
    kept, not_kept = (_solve(path, model_of(paper), history=h) for h in (True, False))
    assert len(kept.history) == kept.iterations == not_kept.iterations
    assert len(not_kept.history) == 0
    np.testing.assert_array_equal(kept.u, not_kept.u)


def test_a_history_is_a_sequence_of_what_callbacks_see(paper):
    model, seen = model_of(paper), []
    found = _solve(PATHS[-1], model, variance_weight=1.0)
    _solve(PATHS[-1], model, variance_weight=1.0, callback=seen.append)
    history = found.history
    assert len(history) == len(list(history)) == len(seen)
    timed = {"linearize_seconds", "solve_seconds"}
    for one, other in zip(history, seen, strict=True):
        for field in dataclasses.fields(one):
            a, b = getattr(one, field.name), getattr(other, field.name)
            if field.name not in timed:
                np.testing.assert_array_equal(a, b, err_msg=field.name)
    assert history[-1].effort == history[len(history) - 1].effort
    assert [h.effort for h in history[2:5]] == [history[i].effort for i in (2, 3, 4)]
    assert [h.effort for h in history[::-2]] == [h.effort for h in list(history)[::-2]]
    assert history[99:] == ()
    assert [h.step for h in reversed(history)] == [h.step for h in history][::-1]
    for index in (len(history), -len(history) - 1):
        with pytest.raises(IndexError):
            history[index]
    np.testing.assert_array_equal(history[-1].controls, found.u)


@pytest.mark.parametrize("path", PATHS)
def test_what_is_said_of_steps_is_what_they_are(paper, path, cost_of_controls):
    model, w = model_of(paper), 2.0
    found = _solve(path, model, variance_weight=w, tolerance=1e-12)
    dt = model.dt
    before = model.guess()[1]
    for h in found.history:
        assert h.effort == pytest.approx(
            np.einsum("k,ki,ij,kj", dt, h.controls, model.R, h.controls)
        )
        c = np.maximum(paper.penalty(model.times[1:], h.mean[1:]), 0.0)
        assert h.penalty == pytest.approx(dt @ (c * c @ model.weight), rel=1e-9, abs=1e-12)
        if h.accepted:
            assert h.step == pytest.approx(
                dt @ ((h.controls - before) ** 2).sum(axis=1), rel=1e-6, abs=1e-20
            )
            before = h.controls
    last = found.history[-1]
    S = np.einsum("k,kii", dt, found.covariance[1:])
    assert last.variance == pytest.approx(S, rel=1e-6)
    assert last.terminal_residual == pytest.approx(np.abs(paper.terminal(found.x[-1])).max())
    # At the end the mean is where the controls lead.
    assert found.effort + found.penalty == pytest.approx(cost_of_controls(paper, found.u), rel=1e-9)
    assert found.objective == pytest.approx(found.effort + found.penalty + w * S, rel=1e-12)


@pytest.mark.parametrize("path", PATHS)
def test_without_a_variance_penalty_its_value_is_not_known(paper, path):
    found = _solve(path, model_of(paper), variance_weight=0.0)
    assert all(np.isnan(h.variance) for h in found.history)


def test_the_seconds_of_a_history_are_within_those_measured(paper):
    model = model_of(paper)
    _solve(PATHS[-1], model)
    began = time.perf_counter()
    history = _solve(PATHS[-1], model).history
    measured = time.perf_counter() - began
    assert all(h.linearize_seconds >= 0.0 for h in history)
    assert all(h.solve_seconds > 0.0 for h in history)
    assert 0.0 < sum(h.seconds for h in history) <= measured


# ------------------------------------------------------------------------------ batches


def test_a_batch_is_the_same_to_the_last_bit_whatever_it_is_made_of():
    worlds = [Scenario.random(seed, 2 + seed % 2, turned=True) for seed in range(30, 42)]

    def controls(problems, workers):
        return [p.controls for p in plan_batch(problems, workers=workers)]

    whole = controls(worlds, 1)
    for workers in (2, 3, 0):
        np.testing.assert_array_equal(controls(worlds, workers), whole)
    np.testing.assert_array_equal(controls(worlds[::-1], 3)[::-1], whole)
    np.testing.assert_array_equal(controls(worlds[5:6], 1), whole[5:6])
    np.testing.assert_array_equal(plan(worlds[7]).controls, whole[7])
