"""A problem's numbers, checked at the boundary: shapes, finiteness, definiteness."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

Array = np.ndarray


def finite(name: str, value: Any, shape: tuple[int | None, ...]) -> Array:
    """A finite float64 array of a shape, None allowing any length of an axis.

    Raises:
        ValueError: naming it, the shape or the entry.
    """
    try:
        if np.iscomplexobj(value):  # NumPy would only warn and drop the imaginary part
            raise TypeError("complex numbers")
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be numbers, not {value!r}") from error
    if not fits(array, shape):
        wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise ValueError(f"{name} must have shape {wanted}, not {array.shape}")
    # A finite sum of squares says it in a third of the time.
    if not np.vdot(array, array) < np.inf and not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}{list(index)} must be finite, not {array[index]}")
    return array


def fits(array: Array, shape: tuple[int | None, ...]) -> bool:
    """Whether an array has a shape, None allowing any length of an axis."""
    return array.shape == shape or (
        array.ndim == len(shape)
        and all(want in (None, got) for got, want in zip(array.shape, shape, strict=True))
    )


def control_weight(value: Any) -> Array:
    """R, (m, m), symmetric positive definite.

    Raises:
        ValueError: if it is not.
    """
    R = finite("control_weight", value, (None, None))
    if not _definite(R.shape, R.tobytes()):
        raise ValueError(f"control_weight must be symmetric positive definite, not {R!r}")
    return R


@functools.lru_cache(maxsize=64)
def _definite(shape: tuple[int, ...], data: bytes) -> bool:
    """Whether a matrix is symmetric and positive definite: many problems have the same."""
    R = np.frombuffer(data).reshape(shape)
    return shape[0] == shape[1] and np.allclose(R, R.T) and bool(np.linalg.eigvalsh(R)[0] > 0)


def node_times(value: Any) -> Array:
    """Nodes of the time grid, (N,), increasing.

    Raises:
        ValueError: if they are not.
    """
    times = finite("times", value, (None,))
    if len(times) < 2 or not (times[1:] > times[:-1]).all():
        raise ValueError(f"times must be at least 2 increasing nodes, not {times!r}")
    return times


def start_covariance(given: Any, n: int) -> Array:
    """Σ_0, (n, n), symmetric positive semidefinite; zero where there is none.

    Raises:
        ValueError: if it is not, naming the entries or the eigenvalue.
    """
    if given is None:
        return np.zeros((n, n))
    S = finite("start_covariance", given, (n, n))
    if not S.any():
        return S
    largest = float(np.abs(S).max())
    bent = np.argwhere(np.abs(S - S.T) > 1e-9 * largest)
    if len(bent):
        i, j = (int(index) for index in bent[0])
        raise ValueError(
            f"start_covariance must be symmetric, but [{i}, {j}] is {S[i, j]:.6g} and "
            f"[{j}, {i}] is {S[j, i]:.6g}"
        )
    S = 0.5 * (S + S.T)
    least = float(np.linalg.eigvalsh(S)[0])
    if least < -1e-9 * largest:
        raise ValueError(
            f"start_covariance must be positive semidefinite, but has the eigenvalue {least:.3g}"
        )
    return S
