"""NumPy's functions with code of ours: choices by conditions, tables, norms and small matrices.

Matrices are inverted by cofactors, A⁻¹ = adj(A)/det(A), since a pivot cannot be chosen by values
that are not known. Minors that are used twice are one expression.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import asarray  # original: see .patches

from slipcar.planner.trace import arrays
from slipcar.planner.trace.arrays import TracedArray, graph_of, lifted, plain, refuse, wrapped
from slipcar.planner.trace.graph import Expression
from slipcar.planner.trace.ufuncs import WHERE

#: Most entries of a table of np.interp, as every segment becomes code, and rows of a matrix.
_LONGEST_TABLE, _LARGEST = 256, 4


def where(condition: Any, *values: Any) -> Any:
    """np.where of three arguments; of one it asks for positions."""
    if len(values) != 2:
        refuse("np.where without values")
    operands, graph = (condition, *values), graph_of((condition, *values))
    given = [plain(v) if graph is None else lifted(graph, v) for v in operands]
    return wrapped(WHERE(*given), TracedArray)


def select(condlist: Sequence[Any], choicelist: Sequence[Any], default: Any = 0) -> Any:
    """np.select: the value of the earliest condition that holds."""
    result = default
    for condition, value in zip(reversed(condlist), reversed(choicelist), strict=True):
        result = where(condition, value, result)
    return result


def piecewise(x: Any, condlist: Any, funclist: Sequence[Any], *args: Any, **kwargs: Any) -> Any:
    """np.piecewise: the value of the last condition that holds."""
    conditions = condlist if isinstance(condlist, (list, tuple)) else [condlist]
    values = [f(x, *args, **kwargs) if callable(f) else f for f in funclist]
    result: Any = 0.0 * x + (values[-1] if len(values) > len(conditions) else 0.0)
    for condition, value in zip(conditions, values, strict=False):
        result = where(condition, value, result)
    return result


def interp(
    x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None
) -> Any:
    """np.interp: piecewise linear, constant outside. At a knot the right slope is taken."""
    graph: Any = graph_of((x, xp, fp, left, right))
    if period is not None:
        refuse("np.interp with period=")
    if len(xp) > _LONGEST_TABLE:
        refuse("np.interp", f"the table has {len(xp)} entries, more than {_LONGEST_TABLE}")

    def number(value: Any) -> Expression:  # whatever is in a table, it makes the same code
        if type(value) is Expression or not graph.tracing:
            return graph.lift(value)
        return graph.number(value, special=False)

    knots, values = plain(asarray(xp)).tolist(), plain(asarray(fp)).tolist()
    at = lifted(graph, x).view(TracedArray)
    edges, heights = list(map(number, knots)), list(map(number, values))
    result: Any = np.full_like(at, heights[0])
    for i in range(len(knots) - 1):
        width = knots[i + 1] - knots[i]
        if type(width) is Expression or width > 0.0:  # else a jump: nothing lies inside
            slope = number((values[i + 1] - values[i]) / width)
            segment = slope * (at - edges[i]) + heights[i]
            result = where(at >= edges[i], segment, result) if i else segment
    result = where(at < edges[0], heights[0] if left is None else left, result)
    beyond = at >= edges[-1] if right is None else at > edges[-1]
    return where(beyond, heights[-1] if right is None else right, result)


def norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    """Norms of vectors of order None, 2, 1 and ∞, and the Frobenius norm of matrices."""
    x, shape = _traced(x), {"axis": axis, "keepdims": keepdims}
    of_matrices = isinstance(axis, tuple) or (axis is None and x.ndim == 2)
    if ord in (None, "fro") or (ord == 2 and not of_matrices):
        return np.sqrt(np.sum(x * x, **shape))
    if ord in (1, np.inf) and not of_matrices:
        return (np.sum if ord == 1 else np.max)(np.abs(x), **shape)
    refuse("np.linalg.norm", f"order {ord} is unknown, write it with np.sum and np.abs")


def _traced(x: Any) -> Any:
    """An array of expressions, each number lifted once."""
    return lifted(graph_of((x,)), x).view(TracedArray)  # type: ignore[arg-type]


def _matrices(a: Any, name: str) -> Any:
    """Matrices (..., n, n), traced; refused if they are too large."""
    a = _traced(a)
    if a.ndim < 2 or a.shape[-1] != a.shape[-2] or a.shape[-1] > _LARGEST:
        refuse(name, f"of shape {a.shape}, more than {_LARGEST} by {_LARGEST} or not square")
    return a


def _determinant(a: Any) -> Any:
    """By Laplace's expansion along the top row."""
    if a.shape[-1] == 1:
        return a[..., 0, 0]
    return sum(a[..., 0, j] * _cofactor(a, 0, j) for j in range(a.shape[-1]))


def _cofactor(a: Any, i: int, j: int) -> Any:
    rows, columns = ([k for k in range(a.shape[-1]) if k != left_out] for left_out in (i, j))
    return (-1.0) ** (i + j) * _determinant(a[..., rows, :][..., columns])


def det(a: Any) -> Any:
    """The determinants of matrices (..., n, n), n ≤ 4."""
    return _determinant(_matrices(a, "np.linalg.det"))


def inv(a: Any) -> Any:
    """The inverses of matrices (..., n, n), n ≤ 4."""
    a = _matrices(a, "np.linalg.inv")
    n = a.shape[-1]
    if n == 1:
        return 1.0 / a
    rows = [np.stack([_cofactor(a, j, i) for j in range(n)], axis=-1) for i in range(n)]
    adjugate = np.stack(rows, axis=-2)
    return adjugate * (1.0 / (a[..., :1, :] @ adjugate[..., :1]))


def solve(a: Any, b: Any) -> Any:
    """Solutions of a x = b for matrices (..., n, n), n ≤ 4; for plain ones of any size."""
    inverse = np.linalg.inv(asarray(a, dtype=float) if graph_of((a,)) is None else a)
    if np.ndim(plain(b)) == 1:
        return wrapped((inverse @ asarray(plain(b))[:, None])[..., 0])
    return wrapped(inverse @ plain(b))


arrays.FUNCTIONS.update(
    {np.where: where, np.select: select, np.piecewise: piecewise, np.interp: interp,
     np.linalg.norm: norm, getattr(np.linalg, "vector_norm", np.linalg.norm): norm,
     np.linalg.det: det, np.linalg.inv: inv, np.linalg.solve: solve}
)  # fmt: skip
