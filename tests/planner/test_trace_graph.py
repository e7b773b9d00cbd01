"""Expressions: folded, shared, differentiated exactly, and evaluated as NumPy would."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from slipcar.planner.trace import arithmetic as op
from slipcar.planner.trace import derivatives
from slipcar.planner.trace.arrays import TracedArray
from slipcar.planner.trace.graph import FUNCTIONS, Graph, TraceError, jacobian, reachable
from slipcar.planner.trace.numpy_code import numpy_function

EPS = np.finfo(float).eps
#: Without those that no complex step can differentiate.
SMOOTH = [name for name in FUNCTIONS if name not in ("abs", "sign", "floor", "erfc", "cbrt")]


def _traced(f, n):
    """The symbols (n,) and what f makes of them as a row x (1, n), flat, all expressions."""
    graph = Graph()
    x = graph.inputs("x", (1, n)).view(TracedArray)
    result = np.asarray(f(x), dtype=object)
    return x[0], [graph.lift(value) for value in result.ravel()]


def derivative(outputs, wrt):
    """∂output/∂wrt for each output."""
    return list(jacobian(np.array([*outputs], dtype=object), np.array([wrt]))[:, 0])


def _compiled(outputs, n):
    function = numpy_function({"x": n}, {"y": outputs})
    return lambda x: function(x=np.atleast_2d(x))["y"]


def _interpreted(outputs, x):
    """Values by walking the graph, real or complex: another way to evaluate."""
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
       for name in SMOOTH if name != "arccosh"},
    "arccosh": (lambda x: np.arccosh(2.0 + x[..., 0] * x[..., 1]), (0.7, 1.1)),
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
    got = _compiled([*outputs, *J.ravel(), *H.ravel()], 2)(point)[0]
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
    got = _compiled([*outputs, *J.ravel(), *H.ravel()], 2)([x, y])[0]
    np.testing.assert_allclose(got[:2], [np.arctan2(y, x), r], rtol=1e-15)
    np.testing.assert_allclose(got[2:6], [-y / r2, x / r2, x / r, y / r], rtol=1e-14)
    np.testing.assert_allclose(got[6:], [*angle.ravel(), *length.ravel()], rtol=1e-13)


def test_derivatives_of_the_error_function_and_the_cube_root_are_the_closed_forms():
    symbols, (f, g) = _traced(lambda x: [x[0, 0].erfc(), np.cbrt(x[0, 0])], 1)
    H = derivative(derivative([f, g], symbols[0]), symbols[0])
    x = np.array([-1.3, -0.2, 0.4, 2.0])
    got = _compiled([f, g, *derivative([f, g], symbols[0]), *H], 1)(x[:, None])
    bell = -2.0 / np.sqrt(np.pi) * np.exp(-x * x)
    known = [np.vectorize(math.erfc)(x), np.cbrt(x), bell, np.cbrt(x) ** -2 / 3, -2 * x * bell,
             -2 / 9 * np.cbrt(x) ** -5]  # fmt: skip
    np.testing.assert_allclose(got, np.stack(known, axis=1), rtol=1e-14)


def test_slopes_are_kept_and_extended():
    graph = Graph()
    x = graph.inputs("x", (2,))
    f = np.sin(x[0] * x[1])
    (before,) = derivative([f], x[0])
    size = graph.size
    assert derivative([f], x[0])[0] is before
    assert graph.size == size
    assert derivative([2.0 * f], x[0])[0] is 2.0 * before
    assert jacobian(np.array([f]), x)[0, 0] is before


def test_steps_have_no_slope_and_choices_that_of_what_is_chosen():
    graph = Graph()
    x, y = graph.inputs("x", (2,))
    for step in (x > y, x >= y, x == y, x != y, op.call("sign", x), op.call("floor", x)):
        assert derivative([step], x)[0].is_zero
    c = x > y
    assert derivative([op.where(c, x * y, y)], x)[0] is op.where(c, y, graph.constant(0.0))
    assert derivative([op.maximum(x, y)], x)[0] is c


def test_a_derivative_with_respect_to_something_else_is_zero():
    graph = Graph()
    x, y = graph.inputs("x", (2,))
    assert all(e.is_zero for e in derivative([np.sin(y), graph.constant(3.0)], x))
    (one,) = derivative([x], x)
    assert one.value == 1.0


def test_a_copied_symbol_is_the_symbol():
    symbols, outputs = _traced(lambda x: copy.deepcopy(x)[0, 0] * copy.copy(x[0, 0]), 1)
    got = _compiled(derivative(outputs, symbols[0]), 1)([3.0])
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
    assert (-x) + y is y - x
    assert (-x) / y is -(x / y)
    assert x / (-y) is -(x / y)
    assert np.sqrt(x * x) is abs(x)
    assert abs(-x) is abs(x)
    assert abs(x * x) is x * x
    assert np.maximum(x, x) is x
    assert (y < x) is (x > y)
    assert (x == y) is (y == x)
    assert op.where(op.negation(x > y), x, y) is op.where(x > y, y, x)
    assert op.where(graph.constant(1.0), x, y) is x
    assert op.where(x > y, x, x) is x
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
    got = _compiled(outputs, 3)(point)[0, 0]
    assert abs(got - plain.value) <= 1e-14 * abs(plain.value) + 4 * plain.error


SPECIAL = np.array(
    [0.0, -0.0, 5e-324, 1e-310, 1e-160, 0.3, -0.3, 1.0, -1.0, 7.0, -7.0, 710.0, -746.0, 1e160,
     -1e160, 1.7e308, np.inf, -np.inf, np.nan]
)  # fmt: skip
UNARY = {
    **{
        name: getattr(np, name)
        for name in (
            *SMOOTH,
            "cbrt",
            "abs",
            "square",
            "reciprocal",
            "negative",
            "sign",
            "floor",
            "ceil",
            "trunc",
        )
    },
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
    "maximum": np.maximum,
    "minimum": np.minimum,
    "copysign": lambda a, b: np.copysign(a, np.where(b != b, 1.0, b) + 0.0),
    "greater": lambda a, b: np.where(a > b, a, b),
    "less_equal": lambda a, b: np.where(a <= b, a, b),
    "equal": lambda a, b: np.where(a == b, 1.0, b),
    "not_equal": lambda a, b: np.where(a != b, 1.0, b),
    "clip": lambda a, b: np.clip(a, -2.0, b),
    "heaviside": lambda a, b: np.where(np.isnan(a), 0.0, np.heaviside(a, b)),
}


@pytest.mark.parametrize("name", UNARY)
def test_functions_have_numpys_values_at_extreme_points_signs_of_zero_included(name):
    f = UNARY[name]
    _, outputs = _traced(f, 1)
    with np.errstate(all="ignore"):
        got = _compiled(outputs, 1)(SPECIAL[:, None])[:, 0]
        known = f(SPECIAL)
    np.testing.assert_allclose(got, known, rtol=4e-15, atol=0.0, equal_nan=True)
    zero = known == 0.0
    np.testing.assert_array_equal(np.signbit(got[zero]), np.signbit(known[zero]))


@pytest.mark.parametrize("name", BINARY)
def test_functions_of_two_have_numpys_values_at_extreme_points(name):
    f = BINARY[name]
    _, outputs = _traced(lambda x: f(x[..., 0], x[..., 1]), 2)
    a, b = (grid.ravel() for grid in np.meshgrid(SPECIAL, SPECIAL))
    with np.errstate(all="ignore"):
        got = _compiled(outputs, 2)(np.stack([a, b], axis=1))[:, 0]
        known = f(a, b)
    np.testing.assert_allclose(got, known, rtol=4e-15, atol=0.0, equal_nan=True)


def test_there_is_one_zero_and_it_is_positive():
    # Whichever zero the code writes first: the branch cut of arctan2 must stay where it is.
    def f(x):
        minus = np.zeros_like(x) * -1.0 + x * -0.0
        return np.arctan2(x * 0.0, x) + minus

    _, outputs = _traced(f, 1)
    assert _compiled(outputs, 1)([-2.0])[0, 0] == np.pi


def test_constants_are_kept_to_the_last_bit():
    values = [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -np.pi, np.inf, -np.inf]
    graph = Graph()
    x = graph.inputs("x", (1,))[0]
    got = _compiled([graph.constant(v) for v in values] + [x], 1)([0.0])
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


# ------------------------------------------------------------------------ code and numbers


def test_rows_that_do_not_match_are_refused():
    graph = Graph()
    x, y = graph.inputs("x", (2,)), graph.inputs("y", (1,))
    function = numpy_function({"x": 2, "y": 1}, {"z": [x[0] * y[0]]})
    with pytest.raises(ValueError, match="y must have 3 rows, not 2"):
        function(x=np.zeros((3, 2)), y=np.zeros((2, 1)))
    shared = numpy_function({"x": 2, "y": 1}, {"z": [x[0] * y[0]]}, frozenset({"y"}))
    with pytest.raises(ValueError, match="y must have 1 rows, not 3"):
        shared(x=np.zeros((3, 2)), y=np.zeros((3, 1)))
    np.testing.assert_array_equal(
        shared(x=np.array([[1.0, 0.0], [2.0, 0.0]]), y=[[3.0]])["z"], [[3.0], [6.0]]
    )


def test_zeros_are_not_computed_and_rows_of_no_width_pass():
    graph = Graph()
    x = graph.inputs("x", (2,))
    function = numpy_function({"x": 2, "none": 0}, {"y": [graph.constant(0.0), x[1]], "empty": []})
    got = function(x=np.array([[1.0, 2.0], [3.0, 4.0]]), none=np.zeros((2, 0)))
    np.testing.assert_array_equal(got["y"], [[0.0, 2.0], [0.0, 4.0]])
    assert got["empty"].shape == (2, 0)


def test_numpy_code_warns_of_nothing_even_where_errors_are_raised():
    _, outputs = _traced(lambda x: np.exp(x) + np.log(x) + 1.0 / x, 1)
    with np.errstate(all="raise"):
        assert np.isnan(_compiled(outputs, 1)([-1e9])[0, 0])


def test_every_operation_has_a_value():
    graph = Graph()
    x = graph.inputs("x", (3,))
    symbols = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
    for name, kind in derivatives.OPERATIONS.items():
        value = _compiled([graph.make(name, tuple(x[: kind.arity]))], 3)([0.4, 0.3, 0.2])[0, 0]
        assert np.isfinite(value) or name == "arccosh"
        if name in symbols:
            assert value == eval(f"0.4 {symbols[name]} 0.3")


def test_numbers_are_an_input_and_constants_are_not():
    graph = Graph()
    (x,) = graph.inputs("x", (1,))
    assert graph.number(2.5) is not graph.number(2.5)
    assert graph.number(1.0) is graph.constant(1.0)
    assert graph.number(1.0, special=False) is not graph.constant(1.0)
    assert graph.numbers == [2.5, 2.5, 1.0]
    assert graph.lift(2.5) is graph.constant(2.5)
    f = graph.number(3.0) * x
    function = numpy_function({"x": 1, "number": 4}, {"y": [f]}, frozenset({"number"}))
    assert function(x=[[2.0]], number=[graph.numbers])["y"] == 6.0


def test_the_structure_counts_order_operands_constants_and_names():
    def key(make):
        graph = Graph()
        x = graph.inputs("x", (2,))
        make(graph, x)
        return graph.structure()

    makers = [
        lambda g, x: None,
        lambda g, x: x[0] + x[1],
        lambda g, x: x[0] - x[1],
        lambda g, x: x[1] - x[0],
        lambda g, x: g.constant(2.0),
        lambda g, x: g.constant(3.0),
        lambda g, x: g.number(3.0),
        lambda g, x: g.number(3.0) * x[0],
        lambda g, x: g.number(3.0) * x[1],
        lambda g, x: g.inputs("y", (1,)),
        lambda g, x: g.inputs("z", (1,)),
        lambda g, x: (g.number(3.0), g.inputs("z", (1,))),
        lambda g, x: (g.inputs("z", (1,)), g.number(3.0)),
    ]
    assert len({key(make) for make in makers}) == len(makers)
    assert key(lambda g, x: g.number(3.0) * x[0]) == key(lambda g, x: g.number(7.0) * x[0])


@pytest.mark.parametrize("use", [bool, float, int, complex, round, lambda e: [0, 1][e]])
def test_questions_about_a_value_say_that_they_cannot_be_traced(use):
    with pytest.raises(TraceError, match="cannot be traced"):
        use(Graph().inputs("x", (1,))[0])


def test_an_expression_of_another_graph_is_refused():
    mine, other = Graph(), Graph()
    kept = other.inputs("x", (1,))[0]
    with pytest.raises(TraceError, match="another trace"):
        mine.lift(kept)
    with pytest.raises(TraceError, match="another trace"):
        mine.inputs("x", (1,))[0] + kept
