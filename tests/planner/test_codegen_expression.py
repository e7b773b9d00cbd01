"""Tracing: the same numbers come out, with exact derivatives, or the code is refused."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from slipcar.planner.trace.expression import (
    FUNCTIONS,
    Graph,
    TraceError,
    derivative,
    jacobian,
    reachable,
)
from slipcar.planner.trace.vectorized import vectorize_kernel

try:
    from slipcar.planner.trace.llvm import compile_kernel
except ImportError:  # without llvmlite there is NumPy code alone
    COMPILERS = {"vectorized": vectorize_kernel}
else:
    COMPILERS = {"vectorized": vectorize_kernel, "llvm": compile_kernel}

EPS = np.finfo(float).eps


def _traced(f, n):
    """The symbols (n,) and what f makes of them as a row x (1, n), flat, all expressions."""
    graph = Graph()
    x = graph.inputs("x", (1, n))
    result = np.asarray(f(x), dtype=object)
    return x[0], [graph.lift(value) for value in result.ravel()]


def _compiled(outputs, n, compiler):
    kernel = compiler({"x": n}, {"y": outputs})
    return lambda x: kernel(x=np.atleast_2d(x))["y"]


def _interpreted(outputs, x):
    """Values by walking the graph, real or complex: a third way to evaluate."""
    known = {}
    binary = {"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide}
    for e in reachable(outputs):
        args = [known[a.index] for a in e.args]
        if e.op == "constant":
            known[e.index] = e.value
        elif e.op == "input":
            known[e.index] = x[e.value[1]]
        elif e.op == "neg":
            known[e.index] = -args[0]
        else:
            known[e.index] = (binary.get(e.op) or getattr(np, e.op))(*args)
    return np.array([known[o.index] for o in outputs])


def _complex_step(f, x):
    """∂f/∂x of f: (n,) complex -> (k,), (k, n)."""
    steps = 1e-30j * np.eye(len(x))
    return np.stack([np.imag(f(x + step)) / 1e-30 for step in steps], axis=-1)


# ------------------------------------------------------------------------------ derivatives

#: Analytic expressions of two variables and a point inside their domain.
ANALYTIC = {
    **{name: (lambda x, name=name: getattr(np, name)(0.3 * x[..., 0] * x[..., 1]), (0.7, 1.1))
       for name in FUNCTIONS},
    "add": (lambda x: x[..., 0] + x[..., 1] + 2.0, (0.4, -1.2)),
    "sub": (lambda x: 1.5 - x[..., 0] - x[..., 1], (0.4, -1.2)),
    "mul": (lambda x: 3.0 * x[..., 0] * x[..., 1] * x[..., 0], (0.4, -1.2)),
    "div": (lambda x: x[..., 0] / x[..., 1] - 2.0 / x[..., 0], (0.4, -1.2)),
    "neg": (lambda x: -(x[..., 0] * -x[..., 1]) + +x[..., 0], (0.4, -1.2)),
    "square": (lambda x: np.square(x[..., 0]) * x[..., 1] ** 2, (0.4, -1.2)),
    "reciprocal": (lambda x: np.reciprocal(x[..., 0] + x[..., 1]), (0.4, -1.2)),
    "power 7": (lambda x: x[..., 0] ** 7 + x[..., 1] ** 1, (-0.9, -1.2)),
    "power -3": (lambda x: x[..., 0] ** -3 * x[..., 1], (-0.9, -1.2)),
    "power 1/2": (lambda x: x[..., 0] ** 0.5 * x[..., 1], (0.9, -1.2)),
    "power 2.3": (lambda x: (x[..., 0] * x[..., 1]) ** 2.3, (0.9, 1.2)),
    "power 17": (lambda x: (x[..., 0] * x[..., 1]) ** 17, (0.9, 1.2)),
    "power of a number": (lambda x: 1.7 ** (x[..., 0] * x[..., 1]), (0.9, -1.2)),
    "power of both": (lambda x: (x[..., 0] * x[..., 1]) ** (x[..., 0] - x[..., 1]), (0.9, 1.2)),
    "nested": (
        lambda x: np.exp(np.sin(x[..., 0] * np.cos(x[..., 1])) ** 3 / (1.0 + x[..., 1] ** 2)),
        (0.7, 1.1),
    ),
    "shared": (lambda x: (s := np.sin(x[..., 0])) * s + s / (s + x[..., 1]), (0.7, 1.1)),
}  # fmt: skip


@pytest.mark.parametrize("name", ANALYTIC)
def test_first_and_second_derivatives_are_those_of_the_complex_step(name):
    f, point = ANALYTIC[name]
    point = np.array(point)
    symbols, outputs = _traced(f, 2)
    J = jacobian(np.array(outputs, dtype=object), symbols)
    H = jacobian(J, symbols)
    assert J.shape == (1, 2)
    assert H.shape == (1, 2, 2)
    exact = _complex_step(lambda z: np.atleast_1d(f(z)), point)
    bent = _complex_step(lambda z: _interpreted(J[0], z), point)
    for compiler in COMPILERS.values():
        everything = [*outputs, *J.ravel(), *H.ravel()]
        got = _compiled(everything, 2, compiler)(point)[0]
        np.testing.assert_allclose(got[0], f(point), rtol=1e-14)
        np.testing.assert_allclose(got[1:3], exact[0], rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(got[3:].reshape(2, 2), bent, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(got[4], got[5], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("y", [-1.3, 0.4])
@pytest.mark.parametrize("x", [-0.8, 2.1])
def test_derivatives_of_what_is_not_analytic_are_the_closed_forms(x, y):
    symbols, outputs = _traced(
        lambda z: np.stack([np.arctan2(z[..., 1], z[..., 0]), np.hypot(z[..., 0], z[..., 1])]), 2
    )
    J = jacobian(np.array(outputs, dtype=object), symbols)
    H = jacobian(J, symbols)
    r2 = x * x + y * y
    r = np.sqrt(r2)
    angle = np.array([[2 * x * y, y * y - x * x], [y * y - x * x, -2 * x * y]]) / r2**2
    length = np.array([[y * y, -x * y], [-x * y, x * x]]) / r**3
    for compiler in COMPILERS.values():
        got = _compiled([*outputs, *J.ravel(), *H.ravel()], 2, compiler)([x, y])[0]
        np.testing.assert_allclose(got[:2], [np.arctan2(y, x), r], rtol=1e-15)
        np.testing.assert_allclose(got[2:6], [-y / r2, x / r2, x / r, y / r], rtol=1e-14)
        np.testing.assert_allclose(got[6:], [*angle.ravel(), *length.ravel()], rtol=1e-13)


def test_a_derivative_with_respect_to_something_else_is_zero():
    graph = Graph()
    x, y = graph.inputs("x", (2,))
    assert all(e.is_zero for e in derivative([np.sin(y), graph.constant(3.0)], x))
    (one,) = derivative([x], x)
    assert one.value == 1.0


def test_a_copied_symbol_is_the_symbol():
    symbols, outputs = _traced(lambda x: copy.deepcopy(x)[0, 0] * copy.copy(x[0, 0]), 1)
    got = _compiled(derivative(outputs, symbols[0]), 1, vectorize_kernel)([3.0])
    assert got[0, 0] == 6.0


# ------------------------------------------------------------------------------ hash-consing


def test_equal_expressions_are_one_object_however_they_are_written():
    graph = Graph()
    x, y = graph.inputs("x", (2,))
    assert x * y is y * x
    assert x + y is y + x
    assert x - (-y) is x + y
    assert x + (-y) is x - y
    assert (-x) * y is -(x * y)
    negative = -x
    assert -negative is x
    assert np.sin(x + y) is np.sin(y + x)
    assert x**2 is x * x
    assert x**0.5 is np.sqrt(x)
    assert x - y is not y - x
    assert (x - x).is_zero
    assert (0.0 * x).is_zero
    assert 1.0 * x is x
    assert x + 0.0 is x
    assert graph.constant(0.0) is graph.constant(-0.0)


def test_entries_of_two_inputs_are_different():
    graph = Graph()
    assert graph.inputs("x", (2,))[0] is graph.inputs("x", (1, 2))[0, 0]
    assert graph.inputs("x", (1,))[0] is not graph.inputs("y", (1,))[0]


def test_common_parts_are_computed_once():
    # f_{k+1} = sin(f_k) + f_k² f_k: as a tree it has 3^40 leaves.
    def f(x):
        for _ in range(40):
            x = np.sin(x) + x**2 * x
        return x

    symbols, outputs = _traced(f, 1)
    assert len(reachable(outputs)) <= 5 * 40 + 1
    slope = derivative(outputs, symbols[0])
    assert len(reachable(slope)) <= 12 * 40 + 10


# ------------------------------------------------------------------------------ values


class Bounded:
    """A number by plain NumPy arithmetic, and a bound of what rounding may have done to it."""

    def __init__(self, value, error=0.0):
        self.value, self.error = np.float64(value), error

    @classmethod
    def of(cls, value, slopes, args):
        error = sum(abs(s) * a.error for s, a in zip(slopes, args, strict=True))
        return cls(value, error + 4 * EPS * abs(value) + 1e-300)


def _bounded(op, *args):
    """One operation in plain NumPy, with its error bound."""
    v = [a.value for a in args]
    value, slopes = OPERATIONS[op][0](*v), OPERATIONS[op][1](*v)
    return Bounded.of(value, slopes, args)


#: What random trees are made of: the code, and its slopes for the error bound.
OPERATIONS = {
    "add": (lambda a, b: a + b, lambda a, b: (1, 1)),
    "sub": (lambda a, b: a - b, lambda a, b: (1, 1)),
    "mul": (lambda a, b: a * b, lambda a, b: (b, a)),
    "over": (lambda a, b: a / (2.0 + b * b), lambda a, b: (1 / (2 + b * b), a)),
    "neg": (lambda a: -a, lambda a: (1,)),
    "square": (np.square, lambda a: (2 * a,)),
    "cube": (lambda a: a**3, lambda a: (3 * a * a,)),
    "sin": (np.sin, lambda a: (1,)),
    "cos": (np.cos, lambda a: (1,)),
    "arctan": (np.arctan, lambda a: (1,)),
    "tanh": (np.tanh, lambda a: (1,)),
    "bell": (lambda a: np.exp(-(a**2)), lambda a: (1,)),
    "root": (lambda a: np.sqrt(1.0 + a * a), lambda a: (1,)),
    "log1p": (lambda a: np.log1p(a * a), lambda a: (1,)),
    "hypot": (lambda a, b: np.hypot(a, 3.0 + b * b), lambda a, b: (1, 2 * b)),
    "angle": (lambda a, b: np.arctan2(a, 3.0 + b * b), lambda a, b: (1, 1)),
    "power": (lambda a, b: (2.0 + np.sin(a)) ** np.cos(b), lambda a, b: (3, 4)),
}
_ARITY = {name: 2 if name in ("add", "sub", "mul", "over", "hypot", "angle", "power") else 1
          for name in OPERATIONS}  # fmt: skip

leaves = st.one_of(
    st.integers(0, 2),
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 2.0, 0.5, -3.25, 1e-3, 1e3]).map(
        lambda c: ("number", c)
    ),
)
trees = st.recursive(
    leaves,
    lambda inner: st.sampled_from(sorted(OPERATIONS)).flatmap(
        lambda op: st.tuples(st.just(op), *[inner] * _ARITY[op])
    ),
    max_leaves=25,
)


def _grown(tree, symbols):
    """The tree's value for given leaves, symbols or arrays of numbers."""
    if isinstance(tree, int):
        return symbols[tree]
    if tree[0] == "number":
        return tree[1] + 0 * symbols[0]  # as arrays of numbers meet arrays of symbols
    return OPERATIONS[tree[0]][0](*(_grown(branch, symbols) for branch in tree[1:]))


def _grown_bounded(tree, point):
    if isinstance(tree, int):
        return Bounded(point[tree])
    if tree[0] == "number":
        return Bounded(tree[1])
    return _bounded(tree[0], *(_grown_bounded(branch, point) for branch in tree[1:]))


@examples(max_examples=150)
@given(trees, st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_random_expressions_have_the_values_of_plain_numpy(tree, point):
    with np.errstate(over="ignore", invalid="ignore"):
        plain = _grown_bounded(tree, point)
    if not (np.isfinite(plain.value) and plain.error < 1e250):
        return  # extreme values have a test of their own
    graph = Graph()
    outputs = [graph.lift(_grown(tree, graph.inputs("x", (3,))))]
    for compiler in COMPILERS.values():
        got = _compiled(outputs, 3, compiler)(point)[0, 0]
        assert abs(got - plain.value) <= 1e-14 * abs(plain.value) + 4 * plain.error


SPECIAL = np.array(
    [0.0, -0.0, 5e-324, 1e-310, 1e-160, 0.3, -0.3, 1.0, -1.0, 7.0, -7.0, 710.0, -746.0, 1e160,
     -1e160, 1.7e308, np.inf, -np.inf, np.nan]
)  # fmt: skip
UNARY = {
    **{name: getattr(np, name) for name in (*FUNCTIONS, "square", "reciprocal", "negative")},
    "cube": lambda x: x**3,
    "power 2.5": lambda x: x**2.5,
    "power -1.5": lambda x: x**-1.5,
    "power of 2": lambda x: 2.0**x,
    "power of 0": lambda x: 0.0**x,
    "power of -2": lambda x: (-2.0) ** x,
}
BINARY = {
    "add": np.add,
    "subtract": np.subtract,
    "multiply": np.multiply,
    "divide": np.divide,
    "hypot": np.hypot,
    "arctan2": np.arctan2,
    "power": np.power,
}


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", UNARY)
def test_functions_have_numpys_values_at_extreme_points_signs_of_zero_included(name, compiler):
    f = UNARY[name]
    _, outputs = _traced(f, 1)
    with np.errstate(all="ignore"):
        got = _compiled(outputs, 1, COMPILERS[compiler])(SPECIAL[:, None])[:, 0]
        known = f(SPECIAL)
    np.testing.assert_allclose(got, known, rtol=4e-15, atol=0.0, equal_nan=True)
    zero = known == 0.0
    np.testing.assert_array_equal(np.signbit(got[zero]), np.signbit(known[zero]))


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", BINARY)
def test_functions_of_two_have_numpys_values_at_extreme_points(name, compiler):
    f = BINARY[name]
    _, outputs = _traced(lambda x: f(x[..., 0], x[..., 1]), 2)
    a, b = (grid.ravel() for grid in np.meshgrid(SPECIAL, SPECIAL))
    with np.errstate(all="ignore"):
        got = _compiled(outputs, 2, COMPILERS[compiler])(np.stack([a, b], axis=1))[:, 0]
        known = f(a, b)
    np.testing.assert_allclose(got, known, rtol=4e-15, atol=0.0, equal_nan=True)


def test_there_is_one_zero_and_it_is_positive():
    # Whichever zero the code writes first: the branch cut of arctan2 must stay where it is.
    def f(x):
        minus = np.zeros_like(x) * -1.0 + x * -0.0
        return np.arctan2(x * 0.0, x) + minus

    _, outputs = _traced(f, 1)
    for compiler in COMPILERS.values():
        assert _compiled(outputs, 1, compiler)([-2.0])[0, 0] == np.pi


def test_constants_are_kept_to_the_last_bit():
    values = [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -np.pi, np.inf, -np.inf]
    graph = Graph()
    x = graph.inputs("x", (1,))[0]
    for compiler in COMPILERS.values():
        got = _compiled([graph.constant(v) for v in values] + [x], 1, compiler)([0.0])
        assert got[0, :-1].tolist() == values


@examples(max_examples=50)
@given(
    st.sampled_from(["add", "sub", "mul", "truediv", "pow"]),
    st.floats(-8, 8),
    st.one_of(st.floats(-8, 8), st.integers(-4, 4)),
)
def test_arithmetic_of_numbers_is_folded_to_numpys_value(op, a, b):
    graph = Graph()
    with np.errstate(all="ignore"):
        known = getattr(np.float64(a), f"__{op}__")(b)
        try:
            folded = getattr(graph.constant(a), f"__{op}__")(b)
        except TraceError:
            assert op == "truediv"
            assert b == 0
            return
    assert folded.op == "constant"
    np.testing.assert_allclose(folded.value, known, rtol=1e-15)


# ------------------------------------------------------------------------------ array code

W = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 4.0], [5.0, 6.0, 0.0]])


def _assigned(make):
    def f(x):
        y = make(x)
        y[..., 0] = x[..., 1] * x[..., 2]
        return y

    return f


def _views(x):
    y = x.copy()
    tail = y[..., 1:]
    tail *= 2.0
    tail += y[..., :1]
    y[..., 0] -= tail[..., 1]
    return y


def _scattered(x):
    y = np.zeros_like(x)
    np.add.at(y, (slice(None), np.array([0, 0, 2])), x)
    return y


#: Array code that is traced, three numbers in; its value is compared with plain NumPy's.
TRACED = {
    "views and in-place operations on a copy": _views,
    "zeros_like, then assigned": _assigned(np.zeros_like),
    "zeros of the argument's dtype": _assigned(lambda x: np.zeros(x.shape, dtype=x.dtype)),
    "zeros of the result's dtype": _assigned(lambda x: np.zeros(x.shape, np.result_type(x, 1.0))),
    "astype of the argument's dtype": lambda x: (2 * x).astype(x.dtype),
    "add.at": _scattered,
    "out=": lambda x: np.add(x, 1.0, out=x.copy()),
    "where on known conditions": lambda x: np.where([True, False, True], x, x**2),
    "boolean index, known": lambda x: x[..., np.array([True, False, True])],
    "times booleans": lambda x: x * np.array([True, False, True]),
    "integer arrays": lambda x: np.arange(3) * x - np.array([7, 8, 9]) // 2,
    "integer powers": lambda x: x ** np.array([1, 2, -3]),
    "unsigned integers that wrap": lambda x: np.array([250, 9, 1], np.uint8) * np.uint8(3) * x,
    "float32 numbers": lambda x: np.full(3, 0.1, np.float32) * x,
    "NumPy scalars first": lambda x: np.float64(0.1) * x[0, 0] + np.int64(3) - x,
    "matmul": lambda x: x @ W + (W @ x[..., None])[..., 0],
    "matmul of stacks": lambda x: (x[..., None] * W) @ (x[..., None, :] * W),
    "dot, inner, tensordot": lambda x: x.dot(W) + np.inner(x, W) + np.tensordot(x, W, (1, 0)),
    "vdot, outer, kron": lambda x: np.vdot(x, x) * np.outer(x, x) + np.kron(x, x).reshape(3, 3),
    "einsum": lambda x: np.einsum("ij,kj,kj->ki", W, x, x),
    "einsum, optimised": lambda x: np.einsum("ij,kj,lj->ki", W, x, x, optimize=True),
    "cross": lambda x: np.cross(x, [1.0, 2.0, 3.0]) + np.cross(x**2, x),
    "sum, prod, cumsum, cumprod": lambda x: (
        x.sum() + np.prod(x, axis=-1) + np.cumsum(x, -1) + np.cumprod(x, axis=-1)
    ),
    "mean, var, std, average": lambda x: (
        np.mean(x, -1) + np.var(x) + np.std(x, axis=-1) + np.average(x, weights=W[:1])
    ),
    "diff, trapezoid": lambda x: np.diff(x).sum() + (x[..., 1:] + x[..., :-1]).sum(),
    "concatenate, stack, block": lambda x: np.concatenate(
        [x, np.ones((1, 2)), np.stack([x[..., 0], 0 * x[..., 1]], -1), np.block([[x, 1.0]])], -1
    ),
    "flip, roll, tile, repeat, pad": lambda x: (
        np.flip(x) + np.roll(x, 1) + np.tile(x, 2)[:, :3] + np.repeat(x, 2)[:3]
        + np.pad(x, 1)[1:2, 1:-1]
    ),
    "swapaxes, trace, diag, triu": lambda x: (
        np.swapaxes(x[..., None] * W, -1, -2) + np.trace(x[0][:, None] * W) + np.diag(x[0])
        + np.triu(x[..., None] * W)
    ),
    "outer product by broadcasting": lambda x: x[..., :, None] * x[..., None, :],
    "2-norm": lambda x: np.linalg.norm(x, axis=-1) + np.linalg.norm(x),
    "polynomials": lambda x: np.polyval([1.0, 2, 3], x) + np.polynomial.Polynomial([1, 2, 3])(x),
    "real, imag, conj": lambda x: x.real + x.imag + x.conj() + np.real(x) * np.conjugate(x),
    "powers": lambda x: x**x + 2.0**x + x**2.5 + x**-2 + np.power(x, 3) + np.float_power(1.5, 2),
    "element by element": lambda x: np.array([[v * v for v in row] for row in x.tolist()]),
    "vectorize": lambda x: np.vectorize(lambda v: v * v + 1.0)(x),
    "deepcopy": lambda x: copy.deepcopy(x) * 2.0,
    "isreal": lambda x: np.where(np.isreal(x), x, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("name", TRACED)
def test_array_code_is_traced_to_the_same_values(name):
    f = TRACED[name]
    _, outputs = _traced(f, 3)
    for point in ([0.3, 0.7, 0.9], [1.0, 2.0, 0.5], [4.0, 0.1, 3.0]):
        known = np.asarray(f(np.array([point])), dtype=float).ravel()
        for compiler in COMPILERS.values():
            np.testing.assert_allclose(_compiled(outputs, 3, compiler)(point)[0], known, rtol=1e-13)


def _masked(x):
    y = x.copy()
    y[y < 0.0] = 0.0
    return y


def _branch(x):
    return x if x[0, 0] > 0.0 else -x


#: What a trace cannot record, or what would lose it.
REFUSED = {
    "branch": _branch,
    "truth": lambda x: x if x[0, 0] else -x,
    "comparison": lambda x: (x > 0.0) * x,
    "equality": lambda x: (x == 0.0) * x,
    "inequality": lambda x: (x != 0.0) * x,
    "where": lambda x: np.where(x > 0.0, x, 0.0),
    "where by value": lambda x: np.where(x, x, 1.0),
    "boolean mask": _masked,
    "abs": np.abs,
    "builtin abs": abs,
    "fabs": np.fabs,
    "maximum": lambda x: np.maximum(x, 0.0),
    "minimum": lambda x: np.minimum(x, 0.0),
    "builtin max": lambda x: max(x[0]) * x,
    "max": lambda x: np.max(x, axis=-1),
    "argmax": lambda x: np.argmax(x, axis=-1),
    "clip": lambda x: np.clip(x, 0.0, 1.0),
    "sign": np.sign,
    "heaviside": lambda x: np.heaviside(x, 0.5),
    "round": np.round,
    "floor": np.floor,
    "trunc": np.trunc,
    "modulo": lambda x: x % 1.0,
    "floor division": lambda x: x // 1.0,
    "remainder": lambda x: np.remainder(x, 2.0),
    "unwrap": np.unwrap,
    "copysign": lambda x: np.copysign(1.0, x),
    "sort": np.sort,
    "sorted": lambda x: np.array(sorted(x[0])),
    "any": np.any,
    "isnan": lambda x: np.where(np.isnan(x), 0.0, x),
    "isclose": lambda x: np.isclose(x, 0.0) * x,
    "sinc": np.sinc,
    "interpolation": lambda x: np.interp(x, [0.0, 1.0], [2.0, 3.0]),
    "table look-up": lambda x: np.arange(9.0)[x.astype(int)],
    "index": lambda x: np.arange(9.0)[x[0, 0]],
    "piecewise": lambda x: np.piecewise(x, [x < 0.0], [0.0, 1.0]),
    "logical": lambda x: np.logical_and(x, True) * x,
    "membership": lambda x: x * (1.0 if x[0, 0] in [1.0, 2.0] else 3.0),
    "vectorize with a branch": np.vectorize(lambda v: v if v > 0.0 else 0.0),
    "float()": lambda x: float(x[0, 0]) * x,
    "int()": lambda x: int(x[0, 0]) * x,
    "math.cos": lambda x: math.cos(x[0, 0]) * x,
    "astype(float)": lambda x: x.astype(float),
    "astype(complex)": lambda x: x.astype(complex),
    "asarray as float": lambda x: np.asarray(x, dtype=np.float64),
    "sum as float": lambda x: np.sum(x, dtype=float),
    "float array, then assigned": _assigned(lambda x: np.zeros(x.shape)),
    "complex array, then assigned": _assigned(lambda x: np.zeros(x.shape, dtype=complex)),
    "integer array, then assigned": _assigned(lambda x: np.zeros(x.shape, dtype=int)),
    "half-filled": _assigned(lambda x: np.empty(x.shape, dtype=x.dtype)),
    "complex numbers": lambda x: 1j * x,
    "strings": lambda x: x * "2",
    "none": lambda x: x * None,
    "inverse": lambda x: np.linalg.inv(x[..., None] * W),
    "solve": lambda x: np.linalg.solve(W, x[..., None]),
    "determinant": lambda x: np.linalg.det(x[..., None] * W),
    "1-norm": lambda x: np.linalg.norm(x, 1, axis=-1),
    "fft": np.fft.fft,
    "cbrt": np.cbrt,
    "log10": np.log10,
    "division by the number zero": lambda x: x / 0.0,
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_traced_is_refused_and_never_guessed(name):
    f = REFUSED[name]
    # NumPy's own refusals are TypeErrors and the like; `trace` turns all into TraceError.
    with pytest.raises((TypeError, ValueError, AttributeError, IndexError)):
        _traced(f, 3)


@pytest.mark.parametrize(
    "use",
    [
        lambda e: bool(e), lambda e: e < 1.0, lambda e: e >= 1.0, lambda e: e == 1.0,
        lambda e: e != 1.0, abs, float, int, complex, lambda e: [0, 1][e],
    ],
)  # fmt: skip
def test_questions_about_a_value_say_that_they_cannot_be_traced(use):
    with pytest.raises(TraceError, match="cannot be traced"):
        use(Graph().inputs("x", (1,))[0])


def test_an_expression_of_another_trace_is_refused():
    mine, other = Graph(), Graph()
    kept = other.inputs("x", (1,))[0]
    with pytest.raises(TraceError, match="another trace"):
        mine.lift(kept)
    with pytest.raises(TypeError):
        mine.inputs("x", (1,))[0] + kept


def test_rows_that_do_not_match_are_refused_before_native_code_reads_past_them():
    graph = Graph()
    x, y = graph.inputs("x", (2,)), graph.inputs("y", (1,))
    for compiler in COMPILERS.values():
        kernel = compiler({"x": 2, "y": 1}, {"z": [x[0] * y[0]]})
        with pytest.raises(ValueError, match="y must have 3 rows, not 2"):
            kernel(x=np.zeros((3, 2)), y=np.zeros((2, 1)))
        shared = compiler({"x": 2, "y": 1}, {"z": [x[0] * y[0]]}, frozenset({"y"}))
        with pytest.raises(ValueError, match="y must have 1 rows, not 3"):
            shared(x=np.zeros((3, 2)), y=np.zeros((3, 1)))


def test_zeros_are_not_computed_and_rows_of_no_width_pass():
    graph = Graph()
    x = graph.inputs("x", (2,))
    for compiler in COMPILERS.values():
        kernel = compiler({"x": 2, "none": 0}, {"y": [graph.constant(0.0), x[1]], "empty": []})
        got = kernel(x=np.array([[1.0, 2.0], [3.0, 4.0]]), none=np.zeros((2, 0)))
        np.testing.assert_array_equal(got["y"], [[0.0, 2.0], [0.0, 4.0]])
        assert got["empty"].shape == (2, 0)
