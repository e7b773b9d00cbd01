"""What tracing refuses, by name and line; and what it leaves as it was."""

import contextlib
import math
import threading

import numpy as np
import pytest
import scipy.interpolate
import scipy.linalg

from slipcar.planner.trace.graph import Expression, Graph, OpaqueError, TraceError
from slipcar.planner.trace.numpy_code import numpy_function
from slipcar.planner.trace.tracing import trace_call

W = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 4.0], [5.0, 6.0, 0.0]])


def _trace(f, n=3):
    graph = Graph()
    return graph, trace_call("drift", f, graph.inputs("x", (1, n)))


def _assigned(make):
    def f(x):
        y = make(x)
        y[..., 0] = x[..., 1] * x[..., 2]
        return y

    return f


def _branch(x):
    if x[0, 0] > 0.0:
        return x
    return -x


def _masked(x):
    y = x.copy()
    y[y < 0.0] = -y[y < 0.0]
    return y


BRANCH = "a branch (if, and, or, while)"
#: Code, what it is refused for, and whether it asks for plain numbers.
REFUSED = {
    "branch": (_branch, BRANCH, False),
    "truth": (lambda x: x if x[0, 0] else -x, BRANCH, False),
    "and": (lambda x: x * (1.0 if x[0, 0] > 0 and x[0, 1] > 0 else 2.0), BRANCH, False),
    "builtin max": (lambda x: max(x[0]) * x, BRANCH, False),
    "sorted": (lambda x: np.array(sorted(x[0])), BRANCH, False),
    "membership": (lambda x: x * (1.0 if x[0, 0] in [1.0, 2.0] else 3.0), BRANCH, False),
    "branch in vectorize": (np.vectorize(lambda v: v if v > 0.0 else 0.0), BRANCH, False),
    "if any": (lambda x: x if (x > 0).any() else -x, BRANCH, False),
    "round": (lambda x: np.round(x), "np.round", False),
    "rint": (lambda x: np.rint(x), "np.rint", False),
    "sort": (lambda x: np.sort(x), "np.sort", False),
    "method sort": (lambda x: x.copy().sort(), "np.sort", False),
    "argmax": (lambda x: np.argmax(x, axis=-1), "np.argmax", False),
    "argsort": (lambda x: x.argsort(), "np.argsort", False),
    "unwrap": (lambda x: np.unwrap(x), "np.unwrap", False),
    "array_equal": (lambda x: x * np.array_equal(x[0], W[0]), "np.array_equal", False),
    "allclose": (lambda x: np.allclose(x, 1.0) * x, "np.allclose", False),
    "median": (lambda x: np.median(x, axis=-1), "np.median", False),
    "nanmax": (lambda x: np.nanmax(x, axis=-1), "np.nanmax", False),
    "unique": (lambda x: np.unique(x), "np.unique", False),
    "digitize": (lambda x: np.digitize(x, W[0]), "np.digitize", False),
    "sinc": (lambda x: np.sinc(x), "np.sinc", False),
    "add.at": (lambda x: np.add.at(x.copy(), 0, 1.0), "np.add.at", False),
    "where=": (lambda x: np.add(x, 1.0, where=W[:1] > 1.0), "np.add", False),
    "where without values": (lambda x: np.where(x > 0), "np.where without values", False),
    "fft": (lambda x: np.fft.fft(x), "np.fft.fft", False),
    "eigenvalues": (lambda x: np.linalg.eigvals(x[..., None] * W), "np.linalg.eigvals", False),
    "large inverse": (lambda x: np.linalg.inv(np.eye(5) * x[0, 0]), "np.linalg.inv", False),
    "matrix norm": (
        lambda x: np.linalg.norm(x[0][:, None] * W, 2), "np.linalg.norm", False,
    ),
    "searchsorted": (lambda x: np.searchsorted(W[0], x), "np.searchsorted", False),
    "nextafter": (lambda x: np.nextafter(x, 1.0), "np.nextafter", False),
    "bits of numbers": (lambda x: ~x, "a bit operation", False),
    "float()": (lambda x: float(x[0, 0]) * x, "float()", True),
    "int()": (lambda x: int(x[0, 0]) * x, "int()", True),
    "complex()": (lambda x: complex(x[0, 0]) * x, "complex()", True),
    "an index": (lambda x: np.arange(9.0)[x[0, 0]], "an index", None),
    "a list's index": (lambda x: [1.0, 2.0][x[0, 0]] * x, "an index", True),
    "table": (lambda x: W[0][np.floor(x)], "an index", None),
    "range": (lambda x: sum(range(x[0, 0])) * x, "an index", True),
    "format": (lambda x: float(f"{x[0, 0]:.3f}") * x, "", None),
    "integers": (lambda x: x.astype(int), "astype(int64)", False),
    "single precision": (lambda x: x.astype(np.float32), "astype(float32)", False),
    "complex numbers": (lambda x: 1j * x, None, False),
    "as complex numbers": (lambda x: x.astype(complex), None, None),
    "complex array, then assigned": (
        _assigned(lambda x: np.zeros(x.shape, dtype=complex)), None, None,
    ),
    "strings": (lambda x: x * "2", None, False),
    "none": (lambda x: x * None, None, None),
    "nothing": (lambda x: None, "return", False),
    "mask": (_masked, "an index", None),
    "half-filled": (_assigned(lambda x: np.empty(x.shape)), "None", False),
    "half-filled, like x": (_assigned(np.empty_like), "None", False),
    "integer array, then assigned": (
        _assigned(lambda x: np.zeros(x.shape, dtype=int)), "int()", True,
    ),
    "own array, then assigned": (_assigned(lambda x: W[:1].copy()), "float()", True),
    "division by the number zero": (lambda x: x / 0.0, "a division by zero", False),
    "SciPy's splines": (
        lambda x: scipy.interpolate.CubicSpline([0.0, 1, 2], [0.0, 1, 0])(x), None, True,
    ),
    "SciPy's matrices": (lambda x: scipy.linalg.expm(x[0][:, None] * W), None, True),
    "its own error": (lambda x: {}["key"], "", False),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_traced_is_refused_by_name_and_line(name):
    f, function, opaque = REFUSED[name]
    with pytest.raises(TraceError) as caught:
        _trace(f)
    error = caught.value
    if opaque is not None:
        assert isinstance(error, OpaqueError) == opaque, error
    if function is not None:
        assert error.function == function
    assert error.where.startswith("test_trace_calls.py:")
    assert error.where in str(error)
    assert str(error).startswith("drift: ")
    assert "drift_jacobian" in str(error)
    assert error.__cause__ is not None


@pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")
def test_torch_is_refused_as_code_that_leaves_numpy():
    torch = pytest.importorskip("torch")
    for f in (torch.tensor, torch.as_tensor, torch.from_numpy):
        with pytest.raises(OpaqueError, match=r"test_trace_calls.py:\d+: .*f\(x\)"):
            _trace(lambda x, f=f: f(x).numpy())


def test_the_line_is_the_users_innermost():
    def helper(v):
        return np.sort(v)  # this line

    def f(x):
        return helper(x) + 1.0

    with pytest.raises(TraceError, match=r"np\.sort") as caught:
        _trace(f)
    number = helper.__code__.co_firstlineno + 1
    assert caught.value.where == f"test_trace_calls.py:{number}: return np.sort(v)  # this line"


def test_where_no_line_of_the_user_is_known_it_is_the_function_or_nothing():
    with pytest.raises(TraceError) as caught:
        _trace(np.sort)
    assert caught.value.where == ""
    assert "()" not in str(caught.value)
    with pytest.raises(TraceError, match="returned None") as caught:
        _trace(_nothing)
    assert caught.value.where.endswith(": def _nothing(x):")


def _nothing(x):
    return None


def test_messages_say_what_to_write_instead():
    for f, instead in (
        (_branch, r"np\.where\(condition, a, b\)"),
        (np.sort, r"np\.minimum and np\.maximum"),
        (np.round, r"np\.floor\(x \+ 0\.5\)"),
        (_assigned(lambda x: W[:1].copy()), r"np\.zeros_like\(x\) or dtype=x\.dtype"),
    ):
        with pytest.raises(TraceError, match=instead):
            _trace(f)


def _write(x):
    x[..., 1] = 0.0
    return x


def _scale(x):
    v = x[..., 1:]
    v *= 0.5
    return x


@pytest.mark.parametrize("f", [_write, _scale, lambda x: np.add(x, 1.0, out=x)])
def test_writing_into_an_argument_is_refused(f):
    graph = Graph()
    x = graph.inputs("x", (1, 3))
    before = x.copy()
    with pytest.raises(TraceError, match=r"drift wrote into its argument x \(.*copy it first"):
        trace_call("drift", f, x)
    assert all(a is b for a, b in zip(x.flat, before.flat, strict=True))


def test_an_expression_of_another_trace_is_refused():
    kept = Graph().inputs("x", (1,))[0]
    with pytest.raises(TraceError, match="another trace"):
        _trace(lambda x: x + kept)
    with pytest.raises(TraceError, match="another trace"):
        _trace(lambda x: kept)


def test_interrupts_are_not_held_up():
    def f(x):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _trace(f)


# ------------------------------------------------------------------------- replaced functions

REPLACED = (np.zeros, np.ones, np.empty, np.full, np.eye, np.array, np.asarray, math.sin, math.pow)


def _replaced():
    return (np.zeros, np.ones, np.empty, np.full, np.eye, np.array, np.asarray, math.sin, math.pow)


@pytest.mark.parametrize(
    "f", [_assigned(lambda x: np.zeros(x.shape)), _branch, lambda x: np.array([math.sin(x[0, 0])])]
)
def test_replaced_functions_are_put_back(f):
    with contextlib.suppress(TraceError):
        _trace(f)
    assert all(a is b for a, b in zip(_replaced(), REPLACED, strict=True))
    assert np.zeros(2).dtype == float
    assert np.vectorize(math.sqrt)(4.0) == 2.0


def test_other_threads_and_those_who_kept_a_replaced_function_get_the_original():
    kept, elsewheres = [], []

    def elsewhere():
        elsewheres.append((np.zeros(3), np.array([1.0]), np.eye(2), np.asarray([2]), math.sin(1.0)))

    def f(x):
        y = np.zeros(x.shape)
        if np.zeros is not REPLACED[0]:
            thread = threading.Thread(target=elsewhere)
            thread.start()
            thread.join()
            kept.extend([np.zeros, np.array, np.full, np.asarray, math.sin, np.empty])
        y[..., 0] = x[..., 1]
        return y

    _trace(f)
    ((zeros, array, eye, given, sine),) = elsewheres
    assert all(type(a) is np.ndarray for a in (zeros, array, eye, given))
    assert [a.dtype for a in (zeros, array, eye)] == [float] * 3
    assert given.dtype == int
    assert sine == math.sin(1.0)
    zeros, array, full, asarray, sin, empty = kept
    assert type(zeros((2, 2))) is np.ndarray
    assert zeros(2, int).dtype == int
    assert zeros(shape=2, dtype="f").dtype == np.float32
    np.testing.assert_array_equal(array([1, 2], ndmin=2), [[1, 2]])
    np.testing.assert_array_equal(full(2, 7.0), [7.0, 7.0])
    assert asarray(W) is W
    assert sin(0.5) == math.sin(0.5)
    assert empty(3).dtype == float


def test_plain_code_within_a_prepared_trace_keeps_its_values():
    def f(x):
        A = np.zeros((3, 3))
        A[0] = [1.0, 2.0, 3.0]
        A += np.eye(3)
        assert A.sum() == 9.0
        table = np.array([0.0, 1.0, 4.0])
        y = np.zeros(x.shape)
        y[..., 0] = x @ A[0] + np.interp(x[..., 0], np.arange(3), table)
        return y + np.ones(3, dtype=int)

    graph, y = _trace(f)
    function = numpy_function({"x": 3, "number": len(graph.numbers)}, {"y": y.ravel()})
    got = function(x=[[0.5, 1.0, -1.0]], number=[graph.numbers])["y"]
    np.testing.assert_allclose(got, [[1.0 + 2.0 - 3.0 + 0.5 + 1.0, 1.0, 1.0]])


# ------------------------------------------------------------------------------- structure


def _car(mass, table):
    def f(x):
        v = x[..., 0]
        drag = mass * v * np.abs(v) + np.interp(v, [-1.0, 0.5, 2.0], table)
        return np.stack([2.0 * drag**2, x[..., 1] / 0.3 + mass], axis=-1)

    return f


def test_the_structure_does_not_depend_on_the_numbers():
    (g, a), (h, b) = (
        _trace(_car(m, c)) for m, c in ((3.0, [2.0, 6.0, 9.0]), (7.5, [0.0, 1.5, 1.5]))
    )
    assert g.structure() == h.structure()
    assert g.structure(a.ravel()) == h.structure(b.ravel())
    assert g.numbers != h.numbers
    # Code of one with the numbers of the other has the other's values.
    function = numpy_function({"x": 3, "number": len(g.numbers)}, {"y": a.ravel()})
    point = np.array([[0.7, -0.4, 0.0]])
    for f, graph in ((_car(3.0, [2.0, 6.0, 9.0]), g), (_car(7.5, [0.0, 1.5, 1.5]), h)):
        got = function(x=point, number=[graph.numbers])["y"]
        np.testing.assert_allclose(got, f(point), rtol=1e-14)


def test_the_structure_tells_other_code_apart():
    codes = [
        lambda x: 3.0 * x, lambda x: 0.0 * x, lambda x: 1.0 * x, lambda x: 3.0 + x,
        lambda x: x**2, lambda x: x**3, lambda x: np.sin(x), lambda x: np.cos(x),
        lambda x: 3.0 * x[..., :2], lambda x: x - 3.0, lambda x: 3.0 - x, lambda x: x * x[..., :1],
        lambda x: np.maximum(x, 3.0), lambda x: np.where(x > 3.0, x, 0.0),
        lambda x: np.where(x >= 3.0, x, 0.0),
    ]  # fmt: skip
    keys = [(g := _trace(f))[0].structure(g[1].ravel()) for f in codes]
    assert len(set(keys)) == len(codes)
    g, y = _trace(lambda x: np.sin(x))
    assert g.structure(y.ravel()) != g.structure(y.ravel()[::-1])


def test_structural_numbers_are_no_parameters():
    graph, y = _trace(lambda x: np.stack([x[..., 0] ** 3 - 1.0, 0.0 * x[..., 1], +x[..., 2]], -1))
    assert graph.numbers == []
    assert y[0, 1].is_zero


def test_every_entry_of_a_result_is_an_expression():
    for f in (lambda x: W, lambda x: [1, 2.0, x[0, 0]], lambda x: True, lambda x: np.zeros(0)):
        _, y = _trace(f)
        assert all(type(e) is Expression for e in y.flat)
        assert y.shape == np.shape(f(np.zeros((1, 3))))


#: What a drift may use.
DRAG = {
    "arctan2": lambda v, x: np.arctan2(v, 1.0 + x * x),
    "hypot": lambda v, x: np.hypot(v, 1.0) - 1.0,
    "interp": lambda v, x: np.interp(x, [-5.0, 0.0, 5.0], [-1.0, 0.0, 1.0]),
    "where": lambda v, x: np.where(v > 0.0, 0.5 * v, v),
    "maximum": lambda v, x: np.maximum(v, 0.1 * v),
    "clip": lambda v, x: np.clip(v, -9.0, 9.0),
    "sign": lambda v, x: v * v * np.sign(v),
    "einsum": lambda v, x: np.einsum("...i,...i->...", np.stack([v, x], -1), np.stack([v, x], -1)),
    "abs": lambda v, x: v * np.abs(v),
    "sqrt": lambda v, x: v * np.sqrt(v**2),
}


@pytest.mark.parametrize("name", DRAG)
def test_a_drift_with_drag_is_traced(name):
    def drift(t, x, u):
        return np.stack([x[..., 1], u[..., 0] - 0.3 * DRAG[name](x[..., 1], x[..., 0])], axis=-1)

    graph = Graph()
    t, x, u = graph.inputs("t", (1,)), graph.inputs("x", (1, 2)), graph.inputs("u", (1, 1))
    b = trace_call("drift", drift, t, x, u)
    function = numpy_function({"x": 2, "u": 1, "number": len(graph.numbers)}, {"b": b.ravel()},
                              frozenset({"number"}))  # fmt: skip
    rng = np.random.default_rng(2)
    x, u = 4.0 * rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    got = function(x=x, u=u, number=[graph.numbers])["b"]
    np.testing.assert_allclose(got, drift(np.zeros(50), x, u), rtol=1e-13, atol=1e-15)
