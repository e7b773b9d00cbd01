"""The LQ problem of a step: recursion, its machine code, and bands against a dense KKT system.

The recursion also tells whether the problem is convex: exactly if every pivot is positive.
"""

import dataclasses
import functools

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from slipcar.planner.lq import riccati
from slipcar.planner.lq.banded import BandedLq, PrimalDual
from slipcar.planner.trace import emit, machine_code
from slipcar.planner.trace.graph import Graph
from slipcar.planner.trace.recursion import Field, Recursion, Symmetric


@dataclasses.dataclass(frozen=True)
class Lq:
    """An LQ problem; Q and q are those of nodes 1..K."""

    A: np.ndarray
    B: np.ndarray
    f: np.ndarray
    Q: np.ndarray
    q: np.ndarray
    R: np.ndarray
    r: np.ndarray
    S: np.ndarray
    G: np.ndarray
    g: np.ndarray


def _random(seed, K, n, m, t, curvature):
    """Q = curvature · (symmetric of either sign) + identity: convex or not, as it comes."""
    rng = np.random.default_rng(seed)
    Q = rng.normal(size=(K, n, n)) / np.sqrt(n)
    L = rng.normal(size=(K, m, m)) / np.sqrt(m)
    return Lq(
        A=np.eye(n) + 0.4 * rng.normal(size=(K, n, n)) / np.sqrt(n),
        B=rng.normal(size=(K, n, m)),
        f=rng.normal(size=(K, n)),
        Q=np.eye(n) + curvature * (Q + Q.swapaxes(1, 2)),
        q=rng.normal(size=(K, n)),
        R=np.eye(m) + L @ L.swapaxes(1, 2),
        r=rng.normal(size=(K, m)),
        S=0.5 * curvature * rng.normal(size=(K, m, n)),
        G=rng.normal(size=(t, n)),
        g=rng.normal(size=t),
    )


# ------------------------------------------------------------------------- the dense system


def _dense(p):
    """The whole problem in z = (e, d): Hessian, gradient, equality constraints M z + v = 0."""
    K, n = p.f.shape
    m, t = p.B.shape[2], len(p.g)
    H, c = np.zeros((K * (m + n), K * (m + n))), np.zeros(K * (m + n))
    M, v = np.zeros((K * n + t, K * (m + n))), np.zeros(K * n + t)
    for k in range(K):
        e, d = slice(k * m, (k + 1) * m), slice(K * m + k * n, K * m + (k + 1) * n)
        before, row = slice(d.start - n, d.start), slice(k * n, (k + 1) * n)
        H[e, e], H[d, d], c[e], c[d] = p.R[k], p.Q[k], p.r[k], p.q[k]
        M[row, e], M[row, d], v[row] = p.B[k], -np.eye(n), p.f[k]
        if k > 0:
            M[row, before] = p.A[k]
            H[e, before], H[before, e] = p.S[k], p.S[k].T
    M[K * n :, -n:], v[K * n :] = p.G, p.g
    return H, c, M, v


def _moved_by_controls(p):
    """∂(d_1..d_K)/∂e, (K n, K m)."""
    K, n = p.f.shape
    m = p.B.shape[2]
    M = _dense(p)[2][: K * n]
    return -np.linalg.solve(M[:, K * m :], M[:, : K * m])


def _reduced_hessian(p):
    """Of the cost in the controls alone, the states following: (K m, K m)."""
    Z = np.vstack([np.eye(p.r.size), _moved_by_controls(p)])
    return Z.T @ _dense(p)[0] @ Z


def _moves_the_end(p):
    """Gramian: what the end moves by for a multiplier of the terminal condition, (t, t)."""
    ends = p.G @ _moved_by_controls(p)[-p.f.shape[1] :]
    return ends @ np.linalg.solve(_reduced_hessian(p), ends.T)


def _kkt(p):
    K, n = p.f.shape
    m = p.B.shape[2]
    H, c, M, v = _dense(p)
    zero = np.zeros((len(v), len(v)))
    z = np.linalg.solve(np.block([[H, M.T], [M, zero]]), -np.concatenate([c, v]))
    e, d, rest = np.split(z, [K * m, K * (m + n)])
    return PrimalDual(d.reshape(K, n), e.reshape(K, m), rest[: K * n].reshape(K, n), rest[K * n :])


# ------------------------------------------------------------------------------- ways to solve


def _softness(p):
    """Of the terminal condition: a part of how far controls of unit cost move the end."""
    free = dataclasses.replace(p, Q=np.zeros_like(p.Q), S=np.zeros_like(p.S))
    with np.errstate(all="ignore"):
        try:
            return riccati.SOFTNESS * np.trace(_moves_the_end(free))
        except np.linalg.LinAlgError:
            return 0.0


@np.errstate(all="ignore")
def _by_recursion(p):
    """None if a pivot is not positive, or a multiplier not finite."""
    K, n = p.f.shape
    Q, q = np.concatenate([0.0 * p.Q[:1], p.Q]), np.concatenate([0.0 * p.q[:1], p.q])
    V, laws = [riccati.last_value(Q[K], q[K], p.G)], []
    wrong = 0.0
    for k in range(K - 1, -1, -1):
        value, law, bad = riccati.stage(
            V[0], p.A[k], p.B[k], p.f[k], Q[k], q[k], p.R[k], p.r[k], p.S[k]
        )
        V.insert(0, value)
        laws.insert(0, law)
        wrong += bad
    nu, bad = riccati.terminal_multiplier(V[0], p.g, _softness(p), 0.0 * p.g)
    d, path, controls, adjoint = np.zeros(n), [], [], []
    for k in range(K):
        controls.append(riccati.respond(laws[k], d, nu))
        d = p.A[k] @ d + p.B[k] @ controls[-1] + p.f[k]
        path.append(d)
        adjoint.append(riccati.adjoint(V[k + 1], d, nu))
    good = wrong + bad == 0.0 and np.isfinite(np.sum(adjoint))
    return PrimalDual(np.array(path), np.array(controls), np.array(adjoint), nu) if good else None


@functools.cache
def _code(n, m, t, known=()):
    """Layout and machine code of two sweeps; `known` are entries of A, B that it may rely on."""
    size = n + 1 + t
    layout = {
        "A": Field((n, n)), "B": Field((n, m)), "f": Field((n,)), "Q": Field((n, n)),
        "q": Field((n,)), "R": Field((m, m)), "r": Field((m,)), "S": Field((m, n)),
        "G": Field((t, n), True), "g": Field((t,), True), "softness": Field((), True),
        "V": Field((size, size)), "law": Field((m, size)), "bad": Field((), True),
        "d": Field((n,)), "e": Field((m,)), "adjoint": Field((n,)), "nu": Field((t,), True),
    }  # fmt: skip

    def last(rows):
        return {"V": Symmetric(riccati.last_value(rows["Q"], rows["q"], rows["G"])), "bad": 0.0}

    def backward(rows, carried):
        rows.write_ahead("V", carried["V"])
        given = (rows[name] for name in ("A", "B", "f", "Q", "q", "R", "r", "S"))
        V, law, bad = riccati.stage(carried["V"], *given)
        rows.write("law", law)
        return {"V": Symmetric(V), "bad": carried["bad"] + bad}

    def first(rows, carried):
        nu, bad = riccati.terminal_multiplier(
            carried["V"], rows["g"], rows["softness"], 0.0 * rows["g"]
        )
        rows.write("nu", nu)
        rows.write("bad", carried["bad"] + bad)

    def forward(rows, carried):
        d, nu = carried["d"], rows["nu"]
        e = riccati.respond(rows["law"], d, nu)
        d = rows["A"].dot(d) + rows["B"].dot(e) + rows["f"]
        rows.write("e", e)
        rows.write_ahead("d", d)
        rows.write_ahead("adjoint", riccati.adjoint(rows.ahead("V"), d, nu))
        return {"d": d}

    sweeps = [
        Recursion("backward", backward, last, first, descending=True),
        Recursion("forward", forward, lambda rows: {"d": np.zeros(n)}),
    ]
    graph = Graph()
    entries = {"A": graph.inputs("A", (n, n)), "B": graph.inputs("B", (n, m))}
    for name, i, j, number in known:
        entries[name][i, j] = graph.constant(number)
    text = emit.module(sweeps, graph, layout, entries)
    return layout, machine_code.Code(machine_code.compiled(text), ["backward", "forward"])


def _by_machine_code(p, known=()):
    K, n = p.f.shape
    layout, code = _code(n, p.B.shape[2], len(p.g), known)
    arrays = {
        name: np.full((1 if f.single else K + 1, f.width), np.nan) for name, f in layout.items()
    }
    for name in ("A", "B", "f", "R", "r", "S"):
        arrays[name][:K] = getattr(p, name).reshape(K, -1)
    for name in ("Q", "q"):
        arrays[name][0], arrays[name][1:] = 0.0, getattr(p, name).reshape(K, -1)
    arrays["G"][0], arrays["g"][0], arrays["softness"][0] = p.G.ravel(), p.g, _softness(p)
    table = np.array([a.ctypes.data for a in arrays.values()], dtype=np.int64)
    for sweep in ("backward", "forward"):
        code.short[sweep](K, table.ctypes.data)
    d, adjoint = arrays["d"][1:], arrays["adjoint"][1:]
    good = arrays["bad"][0, 0] == 0.0 and np.isfinite(adjoint.sum())
    return PrimalDual(d, arrays["e"][:K], adjoint, arrays["nu"][0]) if good else None


def _by_bands(p):
    """Knows nothing of convexity."""
    K, n = p.f.shape
    M = np.linalg.inv(p.R)
    system = BandedLq(K, n, len(p.g))
    system.load(p.A, p.B, M, p.S)
    system.end(p.G, np.ones(len(p.g), dtype=bool), np.full(len(p.g), _softness(p)))
    if not system.factor(p.Q):
        return None
    e0 = -np.einsum("kij,kj->ki", M, p.r)
    return system.solve(e0, p.f + np.einsum("kij,kj->ki", p.B, e0), p.q, -p.g)


SOLVERS = {
    "recursion": _by_recursion,
    "machine code": pytest.param(
        _by_machine_code,
        marks=pytest.mark.skipif(not machine_code.available(), reason="needs llvmlite"),
    ),
}
solvers = pytest.mark.parametrize("solve", SOLVERS.values(), ids=SOLVERS)


def _close(found, known, rtol):
    for name in ("d", "e", "adjoint", "terminal"):
        a, b = getattr(found, name), getattr(known, name)
        np.testing.assert_allclose(
            a, b, atol=rtol * (1.0 + np.abs(b).max(initial=0.0)), err_msg=name
        )


# ---------------------------------------------------------------------------------- solutions

dimensions = st.tuples(
    st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 8), st.integers(1, 3)
)


def _solvable(p):
    """Whether its solution is a minimum, and not lost to rounding or to the soft end."""
    values = np.linalg.eigvalsh(_reduced_hessian(p))
    if values[0] <= 1e-2 * values[-1]:
        return False
    scale = _softness(p) / riccati.SOFTNESS
    return np.linalg.eigvalsh(_moves_the_end(p)).min(initial=np.inf) > 1e-5 * scale


@examples(max_examples=40)
@given(dimensions, st.data(), st.sampled_from([0.0, 0.2, 0.6, 1.0]))
def test_recursion_and_bands_agree_with_a_dense_system_where_the_problem_is_convex(
    shape, data, curvature
):
    seed, K, n, m = shape
    t = data.draw(st.integers(0, min(n, K * m)), label="terminal dimension")
    p = _random(seed, K, n, m, t, curvature)
    assume(_solvable(p))
    known = _kkt(p)
    _close(_by_recursion(p), known, 1e-7)
    _close(_by_bands(p), known, 1e-7)


@pytest.mark.skipif(not machine_code.available(), reason="needs llvmlite")
@pytest.mark.parametrize(("n", "m", "t"), [(1, 1, 0), (1, 1, 1), (3, 2, 2), (4, 1, 3), (2, 3, 0)])
def test_machine_code_agrees_with_a_dense_system(n, m, t):
    tried = 0
    for seed in range(20):
        p = _random(seed, 1 + seed % 5 + t, n, m, t, 0.1 * (seed % 7))
        if _solvable(p):
            tried += 1
            _close(_by_machine_code(p), _kkt(p), 1e-7)
    assert tried >= 5


def test_bands_solve_what_is_no_minimum():
    tried = 0
    for seed in range(20):
        p = _random(seed, 4, 3, 2, 2, 1.5)
        values = np.linalg.eigvalsh(_reduced_hessian(p))
        if values[0] < 0.0 and np.abs(values).min() > 1e-2 * values[-1]:
            tried += 1
            _close(_by_bands(p), _kkt(p), 1e-6)
    assert tried >= 5


# ------------------------------------------------------------------------------------ inertia


@examples(max_examples=40)
@given(dimensions, st.floats(0.0, 3.0))
def test_pivots_are_positive_exactly_if_the_reduced_hessian_is(shape, curvature):
    seed, K, n, m = shape
    p = _random(seed, K, n, m, 0, curvature)
    values = np.linalg.eigvalsh(_reduced_hessian(p))
    assume(abs(values[0]) > 1e-3 * abs(values).max())
    assert (_by_recursion(p) is not None) == (values[0] > 0.0)


def test_the_number_of_bad_pivots_is_that_of_negative_eigenvalues():
    # Sylvester's law of inertia: the pivots are those of a congruent matrix.
    for seed in range(30):
        p = _random(seed, 4, 3, 2, 0, 2.0)
        values = np.linalg.eigvalsh(_reduced_hessian(p))
        V, wrong = riccati.last_value(p.Q[-1], p.q[-1], p.G), 0.0
        for k in range(3, -1, -1):
            Q, q = (p.Q[k - 1], p.q[k - 1]) if k else (0.0 * p.Q[0], 0.0 * p.q[0])
            V, _, bad = riccati.stage(V, p.A[k], p.B[k], p.f[k], Q, q, p.R[k], p.r[k], p.S[k])
            wrong += bad
        assert wrong == (values < 0.0).sum()


@solvers
def test_both_outcomes_of_the_inertia_test_occur_with_indefinite_weights(solve):
    outcomes = []
    for seed in range(60):
        p = _random(seed, 4, 3, 2, 0, 0.5 + 0.02 * seed)
        convex = np.linalg.eigvalsh(_reduced_hessian(p))[0] > 0.0
        assert (solve(p) is not None) == convex
        outcomes.append((np.linalg.eigvalsh(p.Q)[:, 0].min() < 0.0, convex))
    assert (True, True) in outcomes  # Q is indefinite, the problem convex all the same
    assert (True, False) in outcomes


@solvers
@pytest.mark.parametrize(("curvature", "convex"), [(-0.99, True), (-1.01, False), (-1.3, False)])
def test_the_borderline_is_where_the_curvature_of_the_state_outweighs_that_of_the_control(
    solve, curvature, convex
):
    # d = e, cost ½ e² + ½ q d² + e + d: convex for q > -1, where e = −2 / (1 + q).
    one, none = np.ones((1, 1, 1)), np.zeros((1, 1, 1))
    p = Lq(
        A=one, B=one, f=none[0], Q=curvature * one, q=one[0], R=one, r=one[0], S=none,
        G=np.zeros((0, 1)), g=np.zeros(0),
    )  # fmt: skip
    found = solve(p)
    assert (found is not None) == convex
    if convex:
        assert found.e[0, 0] == pytest.approx(-2.0 / (1.0 + curvature))


@solvers
def test_indefinite_control_weight_is_refused_even_if_the_last_stage_alone_has_it(solve):
    p = _random(1, 3, 2, 1, 0, 0.0)
    assert solve(p) is not None
    p.R[-1] = -100.0
    assert solve(p) is None


# ------------------------------------------------------------------------------------ the end


@solvers
def test_the_terminal_condition_holds_and_the_adjoint_ends_at_its_multiplier(solve):
    p = _random(3, 6, 4, 2, 3, 0.3)
    found = solve(p)
    np.testing.assert_allclose(p.G @ found.d[-1] + p.g, 0.0, atol=1e-9)
    end = p.Q[-1] @ found.d[-1] + p.q[-1] + p.G.T @ found.terminal
    np.testing.assert_allclose(found.adjoint[-1], end, rtol=1e-9, atol=1e-9)


@solvers
def test_an_end_that_nothing_moves_is_refused(solve):
    p = _random(6, 6, 4, 2, 3, 0.2)
    p.B[:] = 0.0
    assert solve(p) is None


@pytest.mark.parametrize(("missed", "met"), [(0.0, True), (0.9e-9, True), (1.1e-9, False)])
def test_an_end_that_nothing_moves_is_met_up_to_rounding(missed, met):
    V, rounding = np.zeros((3, 3)), np.array([1e-9])
    nu, bad = riccati.terminal_multiplier(V, np.array([missed]), 1e-9, rounding)
    assert (bad == 0.0) == met
    if met:
        assert abs(nu[0]) <= rounding[0]  # nothing to be paid


@solvers
def test_redundant_terminal_conditions_are_met_and_contradictory_ones_never_pass_as_met(solve):
    p = _random(7, 6, 4, 2, 3, 0.2)
    p.G[2], p.g[2] = 2.0 * p.G[0], 2.0 * p.g[0]
    np.testing.assert_allclose(p.G @ solve(p).d[-1] + p.g, 0.0, atol=1e-6)
    p.g[2] += 1.0
    found = solve(p)
    assert found is None or np.abs(p.G @ found.d[-1] + p.g).max() > 0.1


@solvers
@pytest.mark.parametrize("field", ["A", "B", "f", "Q", "q", "R", "r", "G", "g"])
def test_a_number_that_is_not_finite_is_refused(solve, field):
    p = _random(8, 4, 3, 2, 2, 0.2)
    # Infinite R means that a control stays where it is, which is an answer.
    for bad in (np.nan,) if field == "R" else (np.nan, np.inf):
        getattr(p, field).flat[-1] = bad
        assert solve(p) is None, bad


@pytest.mark.skipif(not machine_code.available(), reason="needs llvmlite")
def test_machine_code_that_relies_on_known_entries_gives_the_same_answer():
    p = _random(5, 6, 3, 2, 2, 0.2)
    p.A[:, 0, 0], p.A[:, 2, 1], p.B[:, 0, :] = 1.0, 0.0, 0.0
    known = (("A", 0, 0, 1.0), ("A", 2, 1, 0.0), ("B", 0, 0, 0.0), ("B", 0, 1, 0.0))
    _close(_by_machine_code(p, known), _kkt(p), 1e-9)
