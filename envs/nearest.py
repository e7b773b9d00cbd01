"""The nearest obstacles of every car, in order: for an observation with a fixed number of slots."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from slipcar.envs.arrays import FLOATS, Functions


def nearest(
    slots: int, fields: list[Any], rims: Any, functions: Functions
) -> tuple[list[Any], Any | None]:
    """What is told of the obstacles, the nearest rim first.

    Args:
        slots: how many obstacles to tell of, at most.
        fields: lists of floats over the obstacles, or arrays (k, cars) or (k, 1), the first of
            them (k, cars).
        rims: distance to every rim, (k,) or (k, cars).
        functions: for this kind of component.

    Returns:
        The fields of the nearest obstacle, of the next, and so on: a list of components; or, for
        NumPy, an empty list and a block (cars, fields x obstacles told of) with the same numbers.
    """
    if functions is FLOATS:
        order = sorted(range(len(rims)), key=rims.__getitem__)[:slots]
        return [field[i] for i in order for field in fields], None
    if isinstance(rims, np.ndarray):
        return [], _picked(fields, order_of(rims)[:slots])
    order = _order_of_tensor(rims)[:slots]
    # take_along_dim would be 15 times slower.
    picked = [field.expand(rims.shape).gather(0, order) for field in fields]
    return [field[i] for i in range(order.shape[0]) for field in picked], None


def order_of(rims: np.ndarray) -> np.ndarray:
    """Numbers of the obstacles by distance, (k, cars), each column sorted by its own `rims`.

    `argsort` would look at one car after the other. Here the rows are sorted, all cars at a time,
    by a network of comparisons; the number of an obstacle rides in the last bits of its distance
    (some 1e-6 of it in float32; which of two goes first that are as near as that is chance).
    """
    count = len(rims)
    whole = np.dtype(f"i{rims.dtype.itemsize}")
    keys = rims.view(whole) if rims.flags.c_contiguous else np.ascontiguousarray(rims).view(whole)
    # Floats in the order of integers: those of negative sign backwards.
    signs = keys >> whole.type(8 * whole.itemsize - 1)
    keys = keys ^ (signs & np.iinfo(whole).max)
    low = whole.type((1 << max(count - 1, 1).bit_length()) - 1)
    keys &= ~low
    keys |= np.arange(count, dtype=whole)[:, None]
    rows = list(keys)
    for i, j in comparisons(count):
        rows[i], rows[j] = np.minimum(rows[i], rows[j]), np.maximum(rows[i], rows[j])
    return np.stack(rows) & low


def _order_of_tensor(rims: Any) -> Any:
    """:func:`order_of` for Torch, (k, cars) int64: pointwise, so that a compiler can fuse it."""
    import torch

    if torch.jit.is_tracing():  # for a file: other runtimes cannot look at a float's bits
        return rims.detach().argsort(dim=0)
    count = len(rims)
    whole = {torch.float32: torch.int32, torch.float64: torch.int64}[rims.dtype]
    keys = rims.detach().contiguous().view(whole)
    keys = keys ^ ((keys >> (8 * rims.element_size() - 1)) & torch.iinfo(whole).max)
    low = (1 << max(count - 1, 1).bit_length()) - 1
    rows = [(keys[i] & ~low) | i for i in range(count)]
    for i, j in merge_sort(count):  # no cache: a compiler looks through it, and complains
        rows[i], rows[j] = torch.minimum(rows[i], rows[j]), torch.maximum(rows[i], rows[j])
    return (torch.stack(rows) & low).to(torch.int64)


@functools.lru_cache(maxsize=64)
def comparisons(count: int) -> tuple[tuple[int, int], ...]:
    """:func:`merge_sort`, kept."""
    return merge_sort(count)


def merge_sort(count: int) -> tuple[tuple[int, int], ...]:
    """Batcher's odd-even merge sort of `count` rows: pairs to be put in order, one by one.

    Knuth, The Art of Computer Programming 3, 5.2.2, Algorithm M.
    """
    pairs = []
    top = 1 << max(0, (count - 1).bit_length() - 1)
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while d > 0:
            pairs += [(i, i + d) for i in range(count - d) if i & p == r]
            d, q, r = q - p, q >> 1, p
        p >>= 1
    return tuple(pairs)


def _picked(fields: list[np.ndarray], order: np.ndarray) -> np.ndarray:
    """The fields in this order, side by side: (cars, fields x len(order))."""
    width, (count, cars) = len(fields), fields[0].shape
    table = np.empty((count, cars, width), dtype=fields[0].dtype)
    for i, field in enumerate(fields):  # those that all cars share have one column
        table[:, :, i] = field
    where = np.empty((cars, len(order)), dtype=np.intp)
    np.multiply(order.T, cars, out=where)
    where += np.arange(cars)[:, None]
    return np.take(table.reshape(-1, width), where.ravel(), axis=0).reshape(
        cars, len(order) * width
    )
