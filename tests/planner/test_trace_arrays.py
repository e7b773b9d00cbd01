"""User code for NumPy arrays, traced: the same numbers come out, with exact derivatives."""

import copy
import functools
import math

import numpy as np
import pytest
import scipy.special

from slipcar.planner.trace.graph import Graph, jacobian
from slipcar.planner.trace.numpy_code import numpy_function
from slipcar.planner.trace.tracing import trace_call

W = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 4.0], [5.0, 6.0, 0.0]])
KNOTS, VALUES = [-2.0, -0.5, 0.4, 1.5, 3.0], [1.0, -1.0, 0.5, 0.5, 4.0]


def _kernel(f, n):
    """Values (K, k), Jacobians (K, k, n) and second derivatives (K, k, n, n) of a traced f."""
    graph = Graph()
    x = graph.inputs("x", (1, n))
    outputs = trace_call("f", f, x).ravel()
    J = jacobian(outputs, x[0])
    H = jacobian(J, x[0])
    function = numpy_function(
        {"x": n, "number": len(graph.numbers)},
        {"f": outputs, "J": J.ravel(), "H": H.ravel()},
        frozenset({"number"}),
    )

    def evaluate(points):
        points = np.atleast_2d(points)
        rows = function(x=points, number=np.array(graph.numbers)[None])
        K, k = len(points), len(outputs)
        return rows["f"], rows["J"].reshape(K, k, n), rows["H"].reshape(K, k, n, n)

    return evaluate


def _differences(f, points):
    """∂f/∂x (K, k, n) of f (K, n) -> (K, k), by central differences of order six."""
    columns = []
    for i in range(points.shape[1]):
        h = np.zeros(points.shape[1])
        h[i] = 2e-3
        d = [f(points + j * h) - f(points - j * h) for j in (1, 2, 3)]
        columns.append((45 * d[0] - 9 * d[1] + d[2]) / (60 * h[i]))
    return np.stack(columns, axis=-1)


def _assigned(make):
    def f(x):
        y = make(x)
        y[..., 0] = x[..., 1] * x[..., 2]
        return y

    return f


def _stacked(f):
    return lambda x: np.stack([f(x[..., 0], x[..., 1])], axis=-1)


def _each(names, f):
    """A function of two numbers for each of NumPy's functions."""
    return {name: _stacked(functools.partial(f, getattr(np, name))) for name in names.split()}


def _masked(x):
    y = x.copy()
    y[x < 1.0] = 0.0
    y[(x > 2.0) & (x < 3.0)] = 7.0
    y[x[..., 0] > x[..., 1] + 2.0] = np.array([5.0])
    return y


#: Functions of two numbers, smooth but for isolated kinks; values in (-3, 3).
ELEMENTWISE = {
    **_each(
        "sin cos arctan sinh cosh tanh exp exp2 expm1 arcsinh abs fabs sign floor ceil trunc square"
        " deg2rad rad2deg radians degrees fix negative",
        lambda f, a, b: f(0.7 * a * b),
    ),
    **_each(
        "log log2 log10 log1p sqrt cbrt reciprocal", lambda f, a, b: f(0.1 + a * a + b * b)
    ),
    **_each("arcsin arccos arctanh tan", lambda f, a, b: f(0.1 * a * b)),
    **_each("arccosh", lambda f, a, b: f(1.1 + a * a + b * b)),
    **_each(
        "maximum minimum fmax fmin hypot arctan2 copysign logaddexp", lambda f, a, b: f(a, b) * a
    ),
    **_each("mod remainder fmod floor_divide", lambda f, a, b: f(2.0 * a, 1.5 + b * b) * a),
    "mod 2": _stacked(lambda a, b: (a * b) % 2.0 + np.fmod(a, 0.7) * np.mod(b, 0.9)),
    "angle in ±π": _stacked(lambda a, b: (3 * a * b + np.pi) % (2 * np.pi) - np.pi),
    "heaviside": _stacked(lambda a, b: np.heaviside(a, 0.5) * b),
    "clip": _stacked(lambda a, b: np.clip(a * b, -1.0, 0.8)),
    "clip on one side": _stacked(lambda a, b: np.clip(a, None, b) + np.clip(b, 0.3, None)),
    "method clip": _stacked(lambda a, b: (a * b).clip(-1.0, 0.8)),
    "drag": _stacked(lambda a, b: a * np.abs(a) + b * np.sqrt(b**2)),
    "power": _stacked(lambda a, b: np.abs(a) ** 1.7 * b**3 + 1.3**b + np.power(a, 2)),
    "half powers": _stacked(lambda a, b: (a * a) ** 1.5 + np.abs(b) ** 2.5 + (a**2 + b**2) ** 0.5),
    "float_power": _stacked(lambda a, b: np.float_power(2.0 + a * a, b)),
    "where": _stacked(lambda a, b: np.where(a > b, a * b, np.where(b <= 0.2, a, np.sin(b)))),
    "where on numbers": _stacked(lambda a, b: np.where(np.floor(a), a, b)),
    "conditions": _stacked(
        lambda a, b: np.where((a > 0.3) & ~(b >= a) | np.logical_xor(a < b, b < -1.0), a * b, b)
    ),
    "logical": _stacked(
        lambda a, b: np.where(
            np.logical_or(np.logical_and(a > 0, b > 0), np.logical_not(a < 1)), a * a, b
        )
    ),
    "condition as factor": _stacked(lambda a, b: (a > 0) * a**2 + (b != 1.0) * (a < b) * b),
    "count": _stacked(lambda a, b: ((a > 0).astype(float) + (b > 0).astype(float)) * a),
    "sum of conditions": _stacked(lambda a, b: np.stack([a > 0, b > 0]).sum(axis=0) * a),
    "or of conditions": _stacked(lambda a, b: ((a > 0) + (b > 0)) * a),
    "any, all": _stacked(
        lambda a, b: np.where(np.any(np.stack([a > 0, b > 1]), axis=0), a, b)
        + np.where(np.all(np.stack([a > 0, b > 1]), axis=0), a * b, b)
    ),
    "select": _stacked(lambda a, b: np.select([a > 1, b > 0, a > -1], [a, b * b, a * b], 0.5 * b)),
    "piecewise": _stacked(lambda a, b: np.piecewise(a, [a < 0, a > 1], [np.sin, 2.0, np.cos]) * b),
    "interp": _stacked(lambda a, b: np.interp(a, KNOTS, VALUES) * b),
    "interp, ends": _stacked(lambda a, b: np.interp(a * b, KNOTS, VALUES, left=-9.0, right=7.0)),
    "norm": lambda x: np.stack(
        [np.linalg.norm(x, axis=-1), np.linalg.norm(x, 1, axis=-1),
         np.linalg.norm(x, np.inf, axis=-1)], axis=-1
    ),
    "max, min": lambda x: np.stack(
        [np.max(x, axis=-1), x.min(axis=-1), np.amax(x * x, -1), np.ptp(x, axis=-1),
         np.maximum.reduce(np.abs(x), axis=-1)], -1
    ),
    "accumulate": lambda x: np.maximum.accumulate(x, axis=-1) * x,
    "erf": _stacked(lambda a, b: scipy.special.erf(a * b) + scipy.special.erfc(a - b) * a),
    "expit": _stacked(lambda a, b: scipy.special.expit(9 * a) * b),
    "xlogy": _stacked(lambda a, b: scipy.special.xlogy(a, 1.0 + b * b)),
    "masks": _masked,
}  # fmt: skip


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_functions_have_numpys_values_and_exact_first_and_second_derivatives(name):
    f = ELEMENTWISE[name]
    points = np.random.default_rng(4).uniform(-3.0, 3.0, size=(200, 2))
    kernel = _kernel(f, 2)
    value, J, H = kernel(points)
    known = np.asarray(f(points), dtype=float).reshape(value.shape)
    np.testing.assert_allclose(value, known, rtol=1e-13, atol=1e-14)
    # Differences across a kink mean nothing: there a few points may be off.
    for exact, differences in (
        (J, _differences(lambda y: np.asarray(f(y), dtype=float).reshape(len(y), -1), points)),
        (H, _differences(lambda y: kernel(y)[1].reshape(len(y), -1), points)),
    ):
        error = np.abs(exact - differences.reshape(exact.shape))
        entries = tuple(range(1, exact.ndim))
        scale = 1.0 + np.abs(exact).max(axis=entries, keepdims=True)
        good = (error <= 1e-6 * scale).all(axis=entries)
        assert good.mean() > 0.93


#: At rest, where formulas would give 0/0: value, first and second derivatives by x[0].
FROM_REST = {
    "v |v|": (lambda v: v * np.abs(v), 0.0, 0.0),
    "v √v²": (lambda v: v * np.sqrt(v**2), 0.0, 0.0),
    "v ‖v‖": (lambda v: v * np.linalg.norm(np.stack([v, 0 * v, v * v]), axis=0), 0.0, 0.0),
    "v √(v² + v⁴)": (lambda v: v * np.sqrt(v * v + v**4), 0.0, None),
    "v hypot(v, 2v)": (lambda v: v * np.hypot(v, 2 * v), 0.0, None),
    "v |v|^0.7": (lambda v: v * np.abs(v) ** 0.7, 0.0, None),
    "v √|v|": (lambda v: v * np.sqrt(np.abs(v)), 0.0, None),
    "√max(v, 0)": (lambda v: np.sqrt(np.maximum(v, 0.0)), 0.0, None),
    "√(4 v²)": (lambda v: np.sqrt(4.0 * v * v), 0.0, None),
    "max(v, 0)": (lambda v: np.maximum(v, 0.0), 0.0, 0.0),
    "max(0, v)": (lambda v: np.maximum(0.0, v), 0.0, 0.0),
    "max(v, 0)²": (lambda v: np.maximum(v, 0.0) ** 2, 0.0, 0.0),
    "|v|": (np.abs, 0.0, 0.0),
    "arctan2(v, v)": (lambda v: np.arctan2(v, v), 0.0, None),
    "logaddexp": (lambda v: np.logaddexp(v, 0.0), 0.5, 0.25),
    "v² sign v": (lambda v: v * v * np.sign(v), 0.0, 0.0),
}


@pytest.mark.parametrize("name", FROM_REST)
def test_derivatives_at_rest_are_finite(name):
    f, slope, bend = FROM_REST[name]
    value, J, H = _kernel(lambda x: np.stack([f(x[..., 0])], axis=-1), 1)([0.0])
    with np.errstate(all="ignore"):
        assert value[0, 0] == f(np.zeros(1))[0]
    np.testing.assert_allclose(J[0, 0, 0], slope, atol=1e-15)
    assert np.isfinite(H).all()
    if bend is not None:
        np.testing.assert_allclose(H[0, 0, 0, 0], bend, atol=1e-12)


def test_an_infinite_slope_is_not_hidden():
    _, J, _ = _kernel(lambda x: np.sqrt(x), 1)([0.0])
    assert J[0, 0, 0] == np.inf


def test_what_is_not_a_number_stays_so():
    def f(x):
        v = x[..., 0]
        return np.stack(
            [np.abs(v), np.maximum(v, 0.0), np.clip(v, -1.0, 1.0), np.sign(v), np.floor(v),
             np.interp(v, KNOTS, VALUES), np.hypot(v, 1.0), v % 2.0, np.logaddexp(v, 0.0)], -1
        )  # fmt: skip

    assert np.isnan(_kernel(f, 1)([np.nan])[0]).all()


def _views(x):
    y = x.copy()
    tail = y[..., 1:]
    tail *= 2.0
    tail += y[..., :1]
    y[..., 0] -= tail[..., 1]
    return y


def _rotation(x):
    R = np.zeros((*x.shape[:-1], 3, 3))
    c, s = np.cos(x[..., 0]), np.sin(x[..., 0])
    R[..., 0, 0], R[..., 0, 1], R[..., 1, 0], R[..., 1, 1] = c, -s, s, c
    R[..., 2, 2] = 1.0
    return (R @ x[..., None])[..., 0]


def _through_views(x):
    R = np.zeros((2, 3))
    np.moveaxis(R, -1, 0)[1] = x[0, :2]
    np.reshape(R, (6,))[0] = x[0, 2]
    R.T[2, 1] = x[0, 0] * x[0, 1]
    return R


def _gathered(x):
    rows = []
    for row in x:
        rows.append(np.array([row[0] * row[1], math.sin(row[2]) + 2.0, max(W[0])]))
    return np.array(rows)


def _inertia(x):
    J = np.eye(3)
    J[0, 1] = J[1, 0] = 0.2
    return np.einsum("ij,...j->...i", np.linalg.inv(J), np.cross(x, x @ J))


def _mass(x):
    M = np.stack([np.stack([2.0 + np.cos(x[..., 0]), x[..., 1]], -1),
                  np.stack([x[..., 1], 5.0 + x[..., 2]], -1)], -2)  # fmt: skip
    return np.linalg.solve(M, x[..., :2, None])[..., 0]


#: Array code that is traced, three numbers in.
TRACED = {
    "views and in-place operations on a copy": _views,
    "zeros_like, then assigned": _assigned(np.zeros_like),
    "zeros_like, of floats": _assigned(lambda x: np.zeros_like(x, float)),
    "full_like, of floats": _assigned(lambda x: np.full_like(x, 2.0, dtype=np.float64)),
    "zeros_like of a slice": _assigned(lambda x: np.zeros_like(x[..., :2])),
    "zeros of floats": _assigned(lambda x: np.zeros(x.shape)),
    "zeros of float64": _assigned(lambda x: np.zeros(x.shape, dtype=np.float64)),
    "ones": _assigned(lambda x: np.ones(x.shape)),
    "full": _assigned(lambda x: np.full(x.shape, 3.5)),
    "full_like": _assigned(lambda x: np.full_like(x, 2.5)),
    "array": _assigned(lambda x: np.array([[1.0, 2.0, 3.0]] * len(x))),
    "zeros of the argument's dtype": _assigned(lambda x: np.zeros(x.shape, dtype=x.dtype)),
    "zeros of the result's dtype": _assigned(lambda x: np.zeros(x.shape, np.result_type(x, 1.0))),
    "functions of what is half assigned": lambda x: np.cos(_assigned(np.zeros_like)(x)) * x,
    "a rotation, filled in": _rotation,
    "row by row": _gathered,
    "inertia": _inertia,
    "a mass matrix": _mass,
    "solutions": lambda x: (
        np.linalg.solve(W, x[0]) + np.linalg.solve(W, x.T)[:, 0]
        + np.linalg.solve(W + x[0, 0], [1.0, 2.0, 3.0]) + np.maximum(np.linalg.solve(W, x[0]), 0.1)
    ),
    "inverse": lambda x: np.linalg.inv(W + x[..., None] * x[..., None, :] + 9 * np.eye(3)),
    "inverse of a diagonal": lambda x: np.linalg.inv(np.diag([x[0, 0], 8.0, x[0, 1] + 9]) + 0.3),
    "array of floats": lambda x: np.array(x, float) + np.array(x[0], dtype=np.float64),
    "matrix-vector products": lambda x: (
        np.matvec(W, x) + np.vecdot(x, x) if hasattr(np, "matvec") else x
    ),
    "determinant": lambda x: np.linalg.det(W + x[..., None] * np.ones(3)),
    "astype(float)": lambda x: (2 * x).astype(float) + x.astype(x.dtype),
    "asarray(float)": lambda x: 2 * np.asarray(x, dtype=float),
    "array of traced scalars": lambda x: np.array([np.abs(x[0, 0]), x[0, 1]]) * 2,
    "array, then compared": lambda x: np.where(np.array([x[0, 0], x[0, 1]]) > 0.5, 1.0, x[0, :2]),
    "math": lambda x: np.array([[math.sin(v) + math.hypot(v, 1.0) + math.pow(v, 3) + math.floor(v)
                                 + math.log(v, 2) + math.atan2(v, 2.0) + math.erf(v) + math.fabs(v)
                                 + math.sqrt(v) + math.sinh(v) for v in row] for row in x]),
    "vectorize with math": lambda x: np.vectorize(lambda v: math.cos(v) + 1.0)(x),
    "out=": lambda x: np.add(x, 1.0, out=x.copy()),
    "out= of floats": lambda x: np.multiply(x, 2.0, out=np.empty(x.shape)),
    "where on known conditions": lambda x: np.where([True, False, True], x, x**2),
    "boolean index, known": lambda x: x[..., np.array([True, False, True])],
    "times booleans": lambda x: x * np.array([True, False, True]),
    "integer arrays": lambda x: np.arange(3) * x - np.array([7, 8, 9]) // 2,
    "integer powers": lambda x: x ** np.array([1, 2, -3]),
    "unsigned integers that wrap": lambda x: np.array([250, 9, 1], np.uint8) * np.uint8(3) * x,
    "float32 numbers": lambda x: np.full(3, 0.1, np.float32) * x,
    "NumPy scalars first": lambda x: np.float64(0.1) * x[0, 0] + np.int64(3) - x,
    "scalars": lambda x: np.sin(x[0, 0]) * x + np.clip(x[0, 1], 0, 1) + np.where(x[0, 2] > 0, 1, 2),
    "array first": lambda x: W[0] - x[0, 0] + (x[0, 1] < W) @ W[0],
    "matmul": lambda x: x @ W + (W @ x[..., None])[..., 0],
    "matmul of stacks": lambda x: (x[..., None] * W) @ (x[..., None, :] * W),
    "dot, inner, tensordot": lambda x: x.dot(W) + np.inner(x, W) + np.tensordot(x, W, (1, 0)),
    "dot by axes": lambda x: np.dot(W, x[0]) + np.tensordot(x, W, axes=([1], [1])),
    "vdot, outer, kron": lambda x: np.vdot(x, x) * np.outer(x, x) + np.kron(x, x).reshape(3, 3),
    "einsum": lambda x: np.einsum("ij,kj,kj->ki", W, x, x),
    "einsum, ellipsis": lambda x: np.einsum("...i,...i->...", x, x * W[0]),
    "einsum, optimised": lambda x: np.einsum("ij,kj,lj->ki", W, x, x, optimize=True),
    "matrix_power": lambda x: np.linalg.matrix_power(x[0, 0] * W + 1.0, 3),
    "scalars: remainders and conditions": lambda x: np.array(
        [x[0, 0] % 0.37, 2.05 % x[0, 1], x[0, 2] // 0.33, 7.1 // x[0, 0],
         np.where((x[0, 0] > 0.5) & ~(x[0, 1] > 1.0) | (x[0, 2] == 3.0), x[0, 0], 1.0)]
    ),
    "isclose": lambda x: np.isclose(x, [0.3, 2.0, 0.9]) * x,
    "gradient": lambda x: np.gradient(x[0], 0.5),
    "convolve": lambda x: np.convolve(x[0], [1.0, -2.0]),
    "vander": lambda x: np.vander(x[0]),
    "views of what is filled in": _through_views,
    "multi_dot": lambda x: np.linalg.multi_dot([W, W, x[0]]),
    "cross": lambda x: np.cross(x, [1.0, 2.0, 3.0]) + np.cross(x**2, x),
    "sum, prod, cumsum, cumprod": lambda x: (
        x.sum() + np.prod(x, axis=-1) + np.cumsum(x, -1) + np.cumprod(x, axis=-1)
    ),
    "sums over axes": lambda x: (
        (x[..., None] * W).sum(axis=(0, 1)) + np.sum(x[..., None] * W, axis=None, keepdims=True)
        + np.max(x[..., None] * W, axis=(-1, -2))
    ),
    "mean, var, std, average": lambda x: (
        np.mean(x, -1) + np.var(x) + np.std(x, axis=-1, ddof=1) + np.average(x, weights=W[:1])
        + x.mean(axis=0)
    ),
    "diff, trapezoid": lambda x: np.diff(x).sum() + (x[..., 1:] + x[..., :-1]).sum(),
    "concatenate, stack, block": lambda x: np.concatenate(
        [x, np.ones((1, 2)), np.stack([x[..., 0], 0 * x[..., 1]], -1), np.block([[x, 1.0]])], -1
    ),
    "hstack, vstack, column_stack": lambda x: np.hstack([x, np.vstack([x, x])[:1]])
    * np.column_stack([x[0], x[0]]).reshape(1, 6),
    "split": lambda x: np.concatenate(np.split(x, 3, axis=-1)[::-1], axis=-1)
    + np.array_split(x, 2, axis=-1)[0].sum(),
    "flip, roll, tile, repeat, pad": lambda x: (
        np.flip(x) + np.roll(x, 1) + np.tile(x, 2)[:, :3] + np.repeat(x, 2)[:3]
        + np.pad(x, 1)[1:2, 1:-1]
    ),
    "swapaxes, trace, diag, triu": lambda x: (
        np.swapaxes(x[..., None] * W, -1, -2) + np.trace(x[0][:, None] * W) + np.diag(x[0])
        + np.triu(x[..., None] * W)
    ),
    "moveaxis, squeeze, expand_dims": lambda x: np.moveaxis(
        np.expand_dims(x, 0), -1, 0).squeeze() + np.broadcast_to(x, (2, 3)).T.transpose(),
    "outer product by broadcasting": lambda x: x[..., :, None] * x[..., None, :],
    "2-norm": lambda x: np.linalg.norm(x, axis=-1) + np.linalg.norm(x, axis=1, keepdims=True)
    + np.linalg.norm(x),
    "polynomials": lambda x: np.polyval([1.0, 2, 3], x) + np.polynomial.Polynomial([1, 2, 3])(x),
    "real, imag, conj": lambda x: x.real + x.imag + x.conj() + np.real(x) * np.conjugate(x),
    "powers": lambda x: x**x + 2.0**x + x**2.5 + x**-2 + np.power(x, 3) + np.float_power(1.5, 2),
    "element by element": lambda x: np.array([[v * v for v in row] for row in x.tolist()]),
    "vectorize": lambda x: np.vectorize(lambda v: v * v + 1.0)(x),
    "frompyfunc": lambda x: np.frompyfunc(lambda v: v * v + 1.0, 1, 1)(x),
    "apply_along_axis": lambda x: np.apply_along_axis(lambda r: r * r.sum(), -1, x),
    "deepcopy": lambda x: copy.deepcopy(x) * 2.0,
    "isfinite": lambda x: np.where(np.isfinite(x), x, 0.0) if np.isfinite(x).all() else x,
    "nan_to_num": lambda x: np.nan_to_num(x) * ~np.isnan(x),
    "numbers alone": lambda x: np.zeros_like(x) + np.sin(np.ones_like(x)) + x,
    "isreal": lambda x: np.where(np.isreal(x), x, 0.0),
    "constants": lambda x: np.array([1.0, 2.5, -0.0]),
    "lists": lambda x: [x[..., 0] * 2, x[..., 1]],
    "builtin sum": lambda x: sum(x[..., i] for i in range(3)),
    "round trip to tuples": lambda x: np.stack(tuple(x[..., i] for i in (2, 1, 0)), -1),
}  # fmt: skip


@pytest.mark.parametrize("name", TRACED)
def test_array_code_is_traced_to_the_same_values(name):
    f = TRACED[name]
    kernel = _kernel(f, 3)
    for point in ([0.3, 0.7, 0.9], [1.0, 2.0, 0.5], [4.0, 0.1, 3.0]):
        known = np.asarray(f(np.array([point])), dtype=float).ravel()
        np.testing.assert_allclose(kernel(point)[0][0], known, rtol=2e-13, atol=1e-15)


def test_a_table_has_the_right_slope_at_its_knots_and_none_outside():
    _, J, _ = _kernel(lambda x: np.interp(x, [0.0, 1.0, 3.0], [0.0, 2.0, 0.0]), 1)(
        np.array([[-1.0], [0.0], [0.5], [1.0], [2.0], [4.0]])
    )
    np.testing.assert_allclose(J[:, 0, 0], [0.0, 2.0, 2.0, -1.0, -1.0, 0.0])
