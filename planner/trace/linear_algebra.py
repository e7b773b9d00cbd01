"""np.linalg on traced arrays: norms, and inverses, solutions and determinants up to 4 by 4.

Matrices are inverted by cofactors, A⁻¹ = adj(A)/det(A), since a pivot cannot be chosen by values
that are not known. Minors that are used twice are one expression.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import array, asarray, empty  # originals: see .patches

from slipcar.planner.trace.array_functions import implements
from slipcar.planner.trace.arrays import TracedArray, graph_of, lifted, plain, refuse
from slipcar.planner.trace.graph import TraceError

Array = np.ndarray
_LARGEST = 4


def _traced(x: Any) -> Any:
    return asarray(plain(x), dtype=object).view(TracedArray)


@implements("linalg.norm", "linalg.vector_norm")
def norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    """Norms of vectors of order None, 2, 1, ∞, −∞ and p, and the Frobenius norm of matrices."""
    x = _traced(x)
    if axis is None and ord is not None and x.ndim == 2 and ord != "fro":
        refuse(f"np.linalg.norm of a matrix with ord={ord}")
    if ord in (None, 2, "fro"):
        return np.sqrt(np.sum(x * x, axis=axis, keepdims=keepdims))
    size = np.abs(x)
    if isinstance(axis, tuple) or isinstance(ord, str):
        refuse(f"np.linalg.norm of a matrix with ord={ord}")
    if ord == 1:
        return np.sum(size, axis=axis, keepdims=keepdims)
    if ord == np.inf:
        return np.max(size, axis=axis, keepdims=keepdims)
    if ord == -np.inf:
        return np.min(size, axis=axis, keepdims=keepdims)
    if not ord:
        refuse("np.linalg.norm with ord=0")
    return np.sum(size**ord, axis=axis, keepdims=keepdims) ** (1.0 / ord)


def _matrices(function: Callable[..., Any], a: Any, name: str) -> Any:
    """Matrices (..., n, n) of expressions, as lists of rows.

    Raises:
        TraceError: if they are too large.
    """
    if a.ndim < 2 or a.shape[-1] != a.shape[-2]:
        raise TraceError(f"{name} needs square matrices, not {a.shape}", name)
    if a.shape[-1] > _LARGEST:
        raise TraceError(
            f"{name} of {a.shape[-1]} by {a.shape[-1]} cannot be traced: at most {_LARGEST}", name
        )
    flat = [function(matrix.tolist()) for matrix in a.reshape(-1, *a.shape[-2:])]
    return flat


def _determinant(rows: list[list[Any]]) -> Any:
    """By Laplace's expansion along the top row."""
    if len(rows) == 1:
        return rows[0][0]
    total: Any = 0.0
    for j, entry in enumerate(rows[0]):
        if not entry.is_zero:
            total = total + (-1.0) ** j * (entry * _determinant(_without(rows, 0, j)))
    return total if type(total) is not float else entry.graph.constant(total)


def _without(rows: list[list[Any]], i: int, j: int) -> list[list[Any]]:
    return [row[:j] + row[j + 1 :] for k, row in enumerate(rows) if k != i]


def _inverse(rows: list[list[Any]]) -> list[list[Any]]:
    n = len(rows)
    if n == 1:
        return [[rows[0][0].reciprocal()]]
    cofactors = [
        [(-1.0) ** (i + j) * _determinant(_without(rows, i, j)) for j in range(n)] for i in range(n)
    ]
    determinant = sum((a * c for a, c in zip(rows[0], cofactors[0], strict=True)), start=0.0)
    scale = 1.0 / determinant
    return [[cofactors[j][i] * scale for j in range(n)] for i in range(n)]


@implements("linalg.det")
def det(a: Any) -> Any:
    """The determinants of matrices (..., n, n), n ≤ 4."""
    graph = graph_of((a,))
    if graph is None:
        return np.linalg.det(asarray(plain(a), dtype=float))
    a = lifted(graph, a)
    values = _matrices(_determinant, a, "np.linalg.det")
    result = empty(len(values), dtype=object)
    result[:] = values
    return result.reshape(a.shape[:-2]).view(TracedArray)[()]


@implements("linalg.inv")
def inv(a: Any) -> Any:
    """The inverses of matrices (..., n, n), n ≤ 4."""
    graph = graph_of((a,))
    if graph is None:
        return np.linalg.inv(asarray(plain(a), dtype=float))
    a = lifted(graph, a)
    values = _matrices(_inverse, a, "np.linalg.inv")
    return array(values, dtype=object).reshape(a.shape).view(TracedArray)


@implements("linalg.solve")
def solve(a: Any, b: Any) -> Any:
    """Solutions of a x = b for matrices (..., n, n), n ≤ 4; for plain ones of any size."""
    graph = graph_of((a, b))
    if graph is None:
        return np.linalg.solve(asarray(plain(a), dtype=float), asarray(plain(b), dtype=float))
    inverse = np.linalg.inv(asarray(a, dtype=float) if graph_of((a,)) is None else a)
    if np.ndim(plain(b)) == 1:
        return (inverse @ _traced(b)[:, None])[..., 0]
    return inverse @ _traced(b)


@implements("linalg.matrix_power")
def matrix_power(a: Any, n: int) -> Any:
    """Whole powers of matrices (..., k, k)."""
    base = np.linalg.inv(a) if n < 0 else a
    result: Any = np.eye(plain(a).shape[-1]) + np.zeros_like(a)
    for _ in range(abs(n)):
        result = result @ base
    return result
