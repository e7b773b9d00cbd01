"""The Riccati recursion of one kind of problem as straight-line code.

What :func:`slipcar.planner.newton.lq.solve_lq` does at a stage, traced: entries of A and B that
are always 0 or 1, and the symmetry of the cost to go, then cost nothing. For the car that is a
quarter of the arithmetic. The code grows with the cube of the dimensions, so large systems are
left to the loops of :mod:`slipcar.planner.newton.riccati`.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.trace.expression import Expression, Graph
from slipcar.planner.trace.llvm import Kernel, compile_kernel

#: Beyond this (state, control and terminal dimensions together) loops take over.
_LARGEST = 18


@dataclasses.dataclass(frozen=True)
class Recursion:
    """Compiled sweeps; V is the cost to go in y = (d, 1, ν), its upper triangle row by row.

    Attributes:
        backward: A, B, f, Q, q (of node k), R, r, S, V (of node k + 1) -> V (of node k),
            gain (m, n + 1 + q), pivot (m).
        forward: A, B, f, gain, V (of node k + 1), nu, d (of node k) -> e, d and adjoint (of
            node k + 1).
    """

    backward: Kernel
    forward: Kernel


def generate(A: np.ndarray, B: np.ndarray, t: int) -> Recursion | None:
    """Compile the sweeps for traced A (n, n) and B (n, m) and q = t; None if it is too large."""
    n, m = B.shape
    if n + m + t > _LARGEST:
        return None
    graph = Graph()
    zero, one = graph.constant(0.0), graph.constant(1.0)

    def like(name: str, traced: np.ndarray) -> np.ndarray:
        """Symbols, but numbers where the traced entries are."""
        symbols = graph.inputs(name, traced.shape)
        for index, entry in np.ndenumerate(traced):
            if entry.op == "constant":
                symbols[index] = graph.constant(entry.value)
        return symbols

    def symmetric(name: str, size: int) -> np.ndarray:
        """Symbols of a full symmetric array, of which the upper triangle is read."""
        full = graph.inputs(name, (size, size))
        lower = np.tril_indices(size, -1)
        full[lower] = full.T[lower]
        return full

    As, Bs = like("A", A), like("B", B)
    f, q, r = graph.inputs("f", (n,)), graph.inputs("q", (n,)), graph.inputs("r", (m,))
    Q, R, S = symmetric("Q", n), symmetric("R", m), graph.inputs("S", (m, n))
    size = n + 1 + t
    V = _unpacked(graph, "V", size, n)
    F = np.full((size, m + size), zero)
    F[:n, :m], F[:n, m : m + n], F[:n, m + n] = Bs, As, f
    F[range(n, size), range(m + n, m + size)] = one
    T = F.T.dot(V).dot(F)
    T[:m, :m] += R
    T[:m, m + n] += r
    T[m + n, :m] += r
    T[:m, m : m + n] += S
    T[m : m + n, :m] += S.T
    T[m : m + n, m : m + n] += Q
    T[m : m + n, m + n] += q
    T[m + n, m : m + n] += q
    pivots = []
    for i in range(m):
        pivots.append(T[i, i])
        row = T[i] / T[i, i]
        T = T - T[:, i, None] * row
        T[i] = row
    gain = T[:m, m:]
    packed = _packed(T[m:, m:], n, zero)
    widths = {"A": n * n, "B": n * m, "f": n}
    stage = {"Q": n * n, "q": n, "R": m * m, "r": m, "S": m * n}
    backward = compile_kernel(
        {**widths, **stage, "V": len(packed)},
        {"V_out": packed, "gain": list(gain.ravel()), "pivot": pivots},
        ahead=frozenset({"V"}),
        descending=True,
    )
    law, nu = graph.inputs("gain", (m, size)), graph.inputs("nu", (t,))
    d = graph.inputs("d", (n,))
    y = np.concatenate([d, [one], nu])
    e = -law.dot(y)
    following = As.dot(d) + Bs.dot(e) + f
    adjoint = V[:n].dot(np.concatenate([following, [one], nu]))
    forward = compile_kernel(
        {**widths, "gain": m * size, "V": len(packed), "nu": t, "d": n},
        {"e": list(e), "d_out": list(following), "adjoint": list(adjoint)},
        shared=frozenset({"nu"}),
        ahead=frozenset({"V", "d_out"}),
    )
    return Recursion(backward, forward)


def _packed(V: np.ndarray, n: int, zero: Expression) -> list[Expression]:
    """Upper triangle, row by row; the constant, entry (n, n), is of no use and left at zero."""
    size = len(V)
    return [zero if i == j == n else V[i, j] for i in range(size) for j in range(i, size)]


def _unpacked(graph: Graph, name: str, size: int, n: int) -> np.ndarray:
    symbols = graph.inputs(name, (size * (size + 1) // 2,))
    V = np.empty((size, size), dtype=object)
    V[np.triu_indices(size)] = symbols
    lower = np.tril_indices(size, -1)
    V[lower] = V.T[lower]
    V[n, n] = graph.constant(0.0)
    return V
