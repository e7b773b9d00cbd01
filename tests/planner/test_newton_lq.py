"""The LQ problem: three implementations against a dense KKT system, and the inertia test."""

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from slipcar.planner.newton import lq, recursion
from slipcar.planner.trace.expression import Graph

riccati = pytest.importorskip("slipcar.planner.newton.riccati", reason="needs numba")
sweep = pytest.importorskip("slipcar.planner.newton.sweep", reason="needs numba").sweep


@dataclasses.dataclass(frozen=True)
class Lq:
    """Arguments of `solve_lq`, in its order."""

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

    @property
    def arrays(self):
        return [getattr(self, field.name) for field in dataclasses.fields(self)]


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


def _reduced_hessian(p):
    """Of the cost in the controls alone, the states following: (K m, K m)."""
    K, n = p.f.shape
    m = p.B.shape[2]
    H, _, M, _ = _dense(p)
    states = -np.linalg.solve(M[: K * n, K * m :], M[: K * n, : K * m])
    Z = np.vstack([np.eye(K * m), states])
    return Z.T @ H @ Z


def _moves_the_end(p):
    """Gramian: what the end moves by for a multiplier of the terminal condition, (q, q)."""
    K, n = p.f.shape
    m = p.B.shape[2]
    _, _, M, _ = _dense(p)
    states = -np.linalg.solve(M[: K * n, K * m :], M[: K * n, : K * m])
    ends = p.G @ states[-n:]
    return ends @ np.linalg.solve(_reduced_hessian(p), ends.T)


def _kkt(p):
    K, n = p.f.shape
    m = p.B.shape[2]
    H, c, M, v = _dense(p)
    zero = np.zeros((len(v), len(v)))
    z = np.linalg.solve(np.block([[H, M.T], [M, zero]]), -np.concatenate([c, v]))
    e, d, rest = np.split(z, [K * m, K * (m + n)])
    return lq.LqSolution(
        d.reshape(K, n), e.reshape(K, m), rest[: K * n].reshape(K, n), rest[K * n :]
    )


def _gramian(p):
    return lq.gramian_trace(p.A, p.B, p.R, p.G)


def _by_lapack(p):
    K, n = p.f.shape
    solver = lq.LqSolver(K, n, p.B.shape[2], len(p.g))
    return solver.solve(*p.arrays, _gramian(p), convex=False)


def _by_loops(p):
    K, n = p.f.shape
    m, t = p.B.shape[2], len(p.g)
    work = riccati.workspace(K, n, m, t)
    d, e, adjoint, nu = (np.full(s, np.nan) for s in ((K, n), (K, m), (K, n), (t,)))
    good = riccati.solve_lq(*p.arrays, _gramian(p), work, d, e, adjoint, nu)
    return lq.LqSolution(d, e, adjoint, nu) if good else None


def _by_generated_code(p, known=None):
    """Through generated sweeps; `known` are entries of A and B that the code may rely on."""
    K, n = p.f.shape
    m, t = p.B.shape[2], len(p.g)
    graph = Graph()
    A, B = graph.inputs("A", (n, n)), graph.inputs("B", (n, m))
    for (array, i, j), number in (known or {}).items():
        {"A": A, "B": B}[array][i, j] = graph.constant(number)
    code = recursion.generate(A, B, t)
    addresses = np.array([0] * 6 + [code.backward.address, code.forward.address])
    size = n + 1 + t
    nodes = np.zeros((K + 1, n, n)), np.zeros((K + 1, n))
    nodes[0][1:], nodes[1][1:] = p.Q, p.q
    d, e, adjoint, nu = (np.full(s, np.nan) for s in ((K + 1, n), (K, m), (K, n), (t,)))
    good = sweep(
        addresses,
        *(p.A, p.B, p.f, *nodes, p.R, p.r, p.S, p.G, p.g, _gramian(p)),
        *(np.zeros((K + 1, size * (size + 1) // 2)), np.empty((K, m, size)), np.empty((K, m))),
        *(d, e, adjoint, nu),
    )
    return lq.LqSolution(d[1:], e, adjoint, nu) if good else None


SOLVERS = {
    "lapack": _by_lapack,
    "loops": _by_loops,
    "generated": _by_generated_code,
}


def _close(found, known, rtol):
    for name in ("d", "e", "adjoint", "terminal"):
        a, b = getattr(found, name), getattr(known, name)
        np.testing.assert_allclose(
            a, b, atol=rtol * (1.0 + np.abs(b).max(initial=0.0)), err_msg=name
        )


dimensions = st.tuples(
    st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 8), st.integers(1, 3)
)


@examples(max_examples=40)
@given(dimensions, st.data(), st.sampled_from([0.0, 0.2, 0.6, 1.0]))
def test_all_agree_with_a_dense_kkt_system_where_the_problem_is_convex(shape, data, curvature):
    seed, K, n, m = shape
    t = data.draw(st.integers(0, min(n, K * m)), label="terminal dimension")
    p = _random(seed, K, n, m, t, curvature)
    values = np.linalg.eigvalsh(_reduced_hessian(p))
    assume(values[0] > 1e-2 * values[-1])
    # Against the softness of the terminal condition, 1e-13 of the Gramian.
    assume(np.linalg.eigvalsh(_moves_the_end(p)).min(initial=np.inf) > 1e-5 * _gramian(p))
    known = _kkt(p)
    for name, solve in SOLVERS.items():
        if name != "generated" or n + m + t <= recursion._LARGEST:
            _close(solve(p), known, 1e-7)


@examples(max_examples=40)
@given(dimensions, st.floats(0.0, 3.0))
def test_the_recursion_succeeds_exactly_if_the_reduced_hessian_is_positive(shape, curvature):
    seed, K, n, m = shape
    p = _random(seed, K, n, m, 0, curvature)
    values = np.linalg.eigvalsh(_reduced_hessian(p))
    assume(abs(values[0]) > 1e-3 * abs(values).max())
    for name, solve in SOLVERS.items():
        assert (solve(p) is not None) == (values[0] > 0.0), name


def test_both_outcomes_of_the_inertia_test_occur_with_indefinite_weights():
    outcomes = []
    for seed in range(60):
        p = _random(seed, 4, 3, 2, 0, 0.5 + 0.02 * seed)
        indefinite = np.linalg.eigvalsh(p.Q)[:, 0].min() < 0.0
        outcomes.append((indefinite, _by_lapack(p) is not None))
    assert (True, True) in outcomes  # Q is indefinite, the problem convex all the same
    assert (True, False) in outcomes


@pytest.mark.parametrize(("curvature", "convex"), [(-0.99, True), (-1.01, False), (-1.3, False)])
def test_the_borderline_is_where_the_curvature_of_the_state_outweighs_that_of_the_control(
    curvature, convex
):
    # d = e, cost ½ e² + ½ q d²: convex for q > -1.
    one, none = np.ones((1, 1, 1)), np.zeros((1, 1, 1))
    p = Lq(
        A=one, B=one, f=none[0], Q=curvature * one, q=none[0], R=one, r=one[0], S=none,
        G=np.zeros((0, 1)), g=np.zeros(0),
    )  # fmt: skip
    for solve in SOLVERS.values():
        found = solve(p)
        assert (found is not None) == convex
        if convex:
            assert found.e[0, 0] == pytest.approx(-1.0 / (1.0 + curvature))


def test_indefinite_control_weight_is_refused_even_if_the_last_stage_alone_has_it():
    p = _random(1, 3, 2, 1, 0, 0.0)
    p.R[-1] = -100.0
    for solve in SOLVERS.values():
        assert solve(p) is None


def test_the_terminal_condition_holds_and_the_adjoint_ends_at_its_multiplier():
    p = _random(3, 6, 4, 2, 3, 0.3)
    for solve in SOLVERS.values():
        found = solve(p)
        np.testing.assert_allclose(p.G @ found.d[-1] + p.g, 0.0, atol=1e-9)
        end = p.Q[-1] @ found.d[-1] + p.q[-1] + p.G.T @ found.terminal
        np.testing.assert_allclose(found.adjoint[-1], end, rtol=1e-9, atol=1e-9)


def test_the_gramian_is_what_the_end_moves_by_for_controls_of_unit_cost():
    p = dataclasses.replace(_random(4, 5, 4, 2, 2, 0.0), Q=np.zeros((5, 4, 4)))
    assert _gramian(p) == pytest.approx(np.trace(_moves_the_end(p)), rel=1e-12)


@pytest.mark.parametrize("K", [1, 4])
def test_a_problem_known_to_be_convex_and_one_without_cross_terms_are_the_same_problem(K):
    p = _random(9, K, 3, 2, 1, 0.0)
    p.S[:] = 0.0
    solver = lq.LqSolver(K, 3, 2, 1)
    arrays = p.arrays
    arrays[7] = None
    for convex in (False, True):
        _close(solver.solve(*p.arrays, _gramian(p), convex=convex), _kkt(p), 1e-9)
        _close(solver.solve(*arrays, _gramian(p), convex=convex), _kkt(p), 1e-9)


def test_code_that_relies_on_known_entries_gives_the_same_answer():
    p = _random(5, 6, 3, 2, 2, 0.2)
    p.A[:, 0, 0], p.A[:, 2, 1], p.B[:, 0, :] = 1.0, 0.0, 0.0
    known = {("A", 0, 0): 1.0, ("A", 2, 1): 0.0, ("B", 0, 0): 0.0, ("B", 0, 1): 0.0}
    _close(_by_generated_code(p, known), _by_lapack(p), 1e-10)


def test_beyond_some_size_no_code_is_generated():
    graph = Graph()
    assert recursion.generate(graph.inputs("A", (30, 30)), graph.inputs("B", (30, 2)), 3) is None


def test_an_end_that_nothing_moves_is_refused():
    p = _random(6, 6, 4, 2, 3, 0.2)
    p.B[:] = 0.0
    for solve in SOLVERS.values():
        assert solve(p) is None


def test_redundant_terminal_conditions_are_met_and_contradictory_ones_never_pass_as_met():
    p = _random(7, 6, 4, 2, 3, 0.2)
    p.G[2], p.g[2] = 2.0 * p.G[0], 2.0 * p.g[0]
    for solve in SOLVERS.values():
        np.testing.assert_allclose(p.G @ solve(p).d[-1] + p.g, 0.0, atol=1e-6)
    p.g[2] += 1.0
    for solve in SOLVERS.values():
        found = solve(p)
        assert found is None or np.abs(p.G @ found.d[-1] + p.g).max() > 0.1


@pytest.mark.parametrize("field", ["A", "B", "f", "Q", "q", "R", "r", "G", "g"])
def test_a_number_that_is_not_finite_is_refused(field):
    p = _random(8, 4, 3, 2, 2, 0.2)
    # Infinite R means that a control stays where it is, which is an answer.
    for bad in (np.nan,) if field == "R" else (np.nan, np.inf):
        getattr(p, field).flat[-1] = bad
        with np.errstate(invalid="ignore"):
            for name, solve in SOLVERS.items():
                assert solve(p) is None, (name, bad)
