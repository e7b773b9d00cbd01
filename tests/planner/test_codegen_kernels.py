"""A problem's functions, traced and compiled, against the problem's own."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner.newton import functions as finding
from slipcar.planner.newton import traced as tracing
from slipcar.planner.newton.functions import functions_of
from slipcar.planner.problem.model import model_of
from slipcar.planner.trace.expression import TraceError

NATIVE = [
    pytest.param(False, id="vectorized"),
    pytest.param(
        True,
        id="llvm",
        marks=pytest.mark.skipif(
            importlib.util.find_spec("llvmlite") is None, reason="needs llvmlite"
        ),
    ),
]


def _boat():
    path = Path(__file__).parents[2] / "examples" / "boat.py"
    spec = importlib.util.spec_from_file_location("boat_example", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Boat()


class Glider:
    """A point in a gusty wind that changes with time; every kind of cost but penalties.

    Three states, two controls, four Brownian motions; one non-linear terminal condition.
    """

    start = np.array([0.3, -0.2, 1.1])
    times = np.linspace(0.0, 2.0, 12) ** 1.3
    control_weight = np.array([[2.0, 0.3], [0.3, 1.0]])
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

    def state_cost(self, t, x):
        return np.cos(x[..., 0]) * (1.0 + t) + x[..., 1] ** 2 * x[..., 2] ** 2

    def control_cost(self, t, x):
        return np.stack([x[..., 0] * x[..., 1], np.sin(t) * x[..., 2] ** 3], axis=-1)


def _cases():
    yield "paper", model_of(Scenario.named("paper"))
    for k in range(9):
        yield f"random world, {k} obstacles", model_of(Scenario.random(k, k, turned=True))
    yield "boat", model_of(_boat())
    yield "glider", model_of(Glider())
    yield "glider, rk4", dataclasses.replace(model_of(Glider()), integrator="rk4")
    yield "paper, rk4", dataclasses.replace(model_of(Scenario.named("paper")), integrator="rk4")


CASES = dict(_cases())


def _points(model, seed=0):
    rng = np.random.default_rng(seed)
    K, n, m, p = len(model.dt), model.state_dim, model.control_dim, len(model.weight)
    q = model.terminal(model.start[None]).shape[1]
    t, x = model.times, model.start + rng.normal(size=(K + 1, n))
    stage = {"t": t[:-1], "dt": model.dt, "x": x[:-1], "u": rng.normal(size=(K, m))}
    node = {"t": t[1:], "x": x[1:]}
    return {
        "stage": stage,
        "node": node,
        "terminal": {"x": x[-1:]},
        "stage_hessian": {**stage, "adjoint": rng.normal(size=(K, n))},
        "node_hessian": {**node, "weight": rng.normal(size=(K, p))},
        "terminal_hessian": {"x": x[-1:], "multiplier": rng.normal(size=(1, q))},
    }


def _functions(model, native):
    found = functions_of(model, *model.guess(), native=native)
    assert found.kernels is not None
    return found


@pytest.mark.parametrize("native", NATIVE)
@pytest.mark.parametrize("case", CASES)
def test_kernels_have_the_values_and_derivatives_of_the_problems_functions(case, native):
    model = CASES[case]
    found, own = _functions(model, native), finding._from_model(model)
    for name, arguments in _points(model).items():
        got, known = getattr(found, name)(**arguments), getattr(own, name)(**arguments)
        assert set(got) == set(known)
        # The problem's own second derivatives are differences.
        for key, value in known.items():
            differences = name.endswith("hessian") or key == "H_xx"
            rtol = 1e-6 if differences else 1e-12
            scale = 1.0 + np.abs(value).max(initial=0.0)
            assert got[key].shape == value.shape
            np.testing.assert_allclose(
                got[key], value, rtol=0.0, atol=rtol * scale, err_msg=f"{name}.{key}"
            )


@pytest.mark.parametrize("native", NATIVE)
@pytest.mark.parametrize("case", CASES)
def test_hessians_are_symmetric_and_linear_in_their_weights(case, native):
    model = CASES[case]
    found, n, m = _functions(model, native), model.state_dim, model.control_dim
    for name, by in (("stage", "adjoint"), ("node", "weight"), ("terminal", "multiplier")):
        arguments = _points(model)[f"{name}_hessian"]
        hessian = getattr(found, f"{name}_hessian")
        got = hessian(**arguments)
        for key, size in (("xx", n), ("uu", m)):
            if key in got:
                square = got[key].reshape(-1, size, size)
                scale = 1.0 + np.abs(square).max(initial=0.0)
                np.testing.assert_allclose(square, square.swapaxes(1, 2), atol=1e-13 * scale)
        if name == "stage" and model.control_cost is not None:
            continue  # dt ℓᵀu has no weight
        twice = hessian(**{**arguments, by: 2.0 * arguments[by]})
        for key in got:
            np.testing.assert_allclose(twice[key], 2.0 * got[key], rtol=1e-12)


def test_llvm_and_numpy_code_agree_to_rounding():
    pytest.importorskip("llvmlite")
    for case in ("paper", "boat", "glider", "glider, rk4"):
        model = CASES[case]
        a, b = (_functions(model, native) for native in (True, False))
        for name, arguments in _points(model, 1).items():
            one, other = getattr(a, name)(**arguments), getattr(b, name)(**arguments)
            for key in one:
                scale = 1.0 + np.abs(other[key]).max(initial=0.0)
                np.testing.assert_allclose(one[key], other[key], atol=1e-14 * scale)


# ------------------------------------------------------------------------------ one kind


@pytest.mark.parametrize("native", NATIVE)
def test_one_compilation_serves_all_worlds_with_as_many_obstacles(native, monkeypatch):
    first = model_of(Scenario.random(11, 3))
    kernels = _functions(first, native).kernels

    def no_more(*args, **kwargs):
        raise AssertionError("compiled anew")

    monkeypatch.setattr(finding, "trace", no_more)
    for seed in (12, 13):
        world = Scenario.random(seed, 3, turned=True, clearance=0.2, slip=(0.3, 0.02))
        model = model_of(world)
        found = _functions(model, native)
        assert found.kernels is kernels
        for name in ("stage", "node", "terminal"):
            arguments = _points(model, seed)[name]
            known = getattr(finding._from_model(model), name)(**arguments)
            for key, value in getattr(found, name)(**arguments).items():
                np.testing.assert_allclose(value, known[key], atol=1e-12)


def test_worlds_with_another_number_of_obstacles_or_integrator_are_another_kind():
    three, four = (model_of(Scenario.random(5, k)) for k in (3, 4))
    euler, rk4 = three, dataclasses.replace(three, integrator="rk4")
    kinds = [tracing.kind_of(model) for model in (three, four, rk4)]
    assert len(set(kinds)) == 3
    assert tracing.kind_of(euler) == tracing.kind_of(model_of(Scenario.random(6, 3)))
    assert tracing.kind_of(CASES["glider"]) is None


def test_an_immutable_problem_is_compared_once_and_its_functions_kept():
    model = model_of(Scenario.random(21, 2))
    x, u = model.guess()
    first = functions_of(model, x, u, native=False)
    assert functions_of(model, x, u, native=False) is first
    other = functions_of(dataclasses.replace(model, integrator="rk4"), x, u, native=False)
    assert other is not first


# ------------------------------------------------------------------------------ no wrong trace


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


def _drifts(found, model):
    return found.stage(**_points(model)["stage"])["next"]


@pytest.mark.parametrize("native", NATIVE)
@pytest.mark.parametrize("change", [0.31, 0.3 + 1e-6, -5.0])
def test_a_problem_that_has_changed_is_traced_anew(native, change):
    cart = Cart()
    model = model_of(cart)
    before = _functions(model, native)
    cart.drag = change
    model = model_of(cart)
    after = _functions(model, native)
    assert after.kernels is not before.kernels
    known = _drifts(finding._from_model(model), model)
    np.testing.assert_allclose(_drifts(after, model), known, rtol=1e-14)
    assert np.abs(_drifts(before, model) - known).max() > 1e-9


def test_a_change_in_small_units_is_noticed_beside_large_ones():
    class Slow(Cart):
        start = np.array([0.0, 1.0, 4e7])  # and a height in metres

        def drift(self, t, x, u):
            slow = 1e-6 * self.drag * x[..., 1]
            return np.stack([x[..., 1], u[..., 0], 1e7 * x[..., 1]], axis=-1) + slow[..., None]

        def terminal(self, x):
            return x[..., :2] - self.goal

    slow = Slow(drag=1.0)
    model = model_of(slow)
    before = _functions(model, False)
    slow.drag = 3.0
    assert _functions(model_of(slow), False).kernels is not before.kernels


def test_mutated_arrays_of_a_closure_are_noticed():
    cart = Cart()
    cart.goal = np.array([1.0, 0.0])
    first = _functions(model_of(cart), False)
    cart.goal[0] = 2.0
    second = _functions(model_of(cart), False)
    model = model_of(cart)
    x = _points(model)["terminal"]["x"]
    np.testing.assert_allclose(second.terminal(x=x)["g"], x - cart.goal)
    np.testing.assert_allclose(first.terminal(x=x)["g"], x - [1.0, 0.0])


def _deceivers():
    """Drifts whose trace computes something else than they do; Cart's is honest."""

    class ByType(Cart):
        def drift(self, t, x, u):
            honest = super().drift(t, x, u)
            return honest if x.dtype == object else 1.5 * honest

    class ByInstance(Cart):
        def drift(self, t, x, u):
            number = isinstance(x.reshape(-1)[0], (float, complex))
            return super().drift(t, x, u) * (2.0 if number else 1.0)

    class Tries(Cart):
        def drift(self, t, x, u):
            try:
                factor = 1.0 + np.round(np.asarray(x.real, dtype=float)[..., :1])
            except TypeError:
                factor = 1.0
            return super().drift(t, x, u) * factor

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

    class NotBatched(Cart):
        def drift(self, t, x, u):
            return super().drift(t, x, u) + 0.1 * np.sum(x)

    class Rounded(Cart):
        def drift(self, t, x, u):
            return super().drift(t, x, u) * np.nan_to_num(np.sqrt(x[..., :1] * x[..., 1:]))

    return [ByType, ByInstance, Tries, Random, Counts, Repr, NotBatched, Rounded]


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("native", NATIVE)
@pytest.mark.parametrize("kind", _deceivers(), ids=lambda kind: kind.__name__)
def test_traces_that_tell_another_story_are_not_used(kind, native):
    model = model_of(kind())
    assert tracing.trace(model, native=False)  # the trace itself sees nothing amiss
    assert functions_of(model, *model.guess(), native=native).kernels is None


class WritesInItsArgument(Cart):
    def drift(self, t, x, u):
        if x.dtype == object:
            x *= 2.0
        return super().drift(t, x, u)


class Branches(Cart):
    """Cart's physics in code that cannot be traced."""

    def drift(self, t, x, u):
        v = np.where(np.isfinite(x[..., 1]), x[..., 1], 0.0)
        return np.stack([v, u[..., 0] - self.drag * v**3], axis=-1)


@pytest.mark.parametrize("kind", [WritesInItsArgument, Branches])
@pytest.mark.parametrize("native", NATIVE)
def test_untraceable_code_is_refused_with_the_reason(kind, native):
    model = model_of(kind())
    with pytest.raises(TraceError, match=r"read-only|isfinite"):
        tracing.trace(model, native=native)
    found = functions_of(model, *model.guess(), native=native)
    assert found.kernels is None
    known = finding._from_model(model_of(Cart()))
    for name, arguments in _points(model).items():
        for key, value in getattr(found, name)(**arguments).items():
            np.testing.assert_allclose(value, getattr(known, name)(**arguments)[key], atol=1e-12)


def test_an_analytic_jacobian_that_contradicts_the_drift_is_kept_as_the_users_word():
    class Contradicts(Cart):
        def drift_jacobian(self, t, x, u):
            A = np.zeros((*x.shape, 2))
            A[..., 0, 1], A[..., 1, 1] = 1.0, -0.9 * self.drag * x[..., 1] ** 2
            return A, np.broadcast_to([[0.0], [1.0]], (*x.shape, 1))

    model = model_of(Contradicts())
    assert functions_of(model, *model.guess(), native=False).kernels is None


def test_problems_of_one_class_that_name_too_little_do_not_get_each_others_numbers():
    class Forgetful(Cart):
        mass = 1.0

        def drift(self, t, x, u):
            return super().drift(t, x, u / self.mass)

        def parameters(self):
            return {"drag": np.asarray(self.drag)}

        def with_parameters(self, parameters):
            copy = object.__new__(Forgetful)
            vars(copy).update({**vars(self), **parameters})
            return copy

    light, heavy = Forgetful(), Forgetful(0.7)
    heavy.mass = 3.0
    for problem in (light, heavy, light):
        model = model_of(problem)
        found = _functions(model, False)
        known = _drifts(finding._from_model(model), model)
        np.testing.assert_allclose(_drifts(found, model), known, rtol=1e-13)
