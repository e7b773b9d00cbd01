"""Derivatives by the complex step: exact to machine precision for analytic functions.

    ∂f/∂x_i = Im f(x + i h e_i) / h,   h = 1e-30

No subtraction takes place, so h can be as small as one likes (Squire and Trapp, 1998).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_STEP = 1e-30
#: Step of a central difference, relative: the cube root of the machine precision.
_DIFFERENCE = 6e-6


def complex_step_jacobian(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Jacobian of a function batched over leading axes.

    Args:
        f: analytic, (..., n) -> (..., *out); must let complex arrays pass, or be constant.
        x: points, (..., n).

    Returns:
        (..., *out, n): the last axis is the entry of x that is differentiated.

    Raises:
        TypeError: if `f` returns real numbers for complex arguments (a cast inside it loses
            the derivative).
    """
    columns = []
    for i in range(x.shape[-1]):
        shifted = x.astype(np.complex128)
        shifted[..., i] += 1j * _STEP
        value = np.asarray(f(shifted))
        if not np.iscomplexobj(value) and _responds(f, x, i):
            raise TypeError(
                "the function returned real numbers for complex arguments, so the complex step "
                "finds no derivative: avoid casts to float, or give an analytic Jacobian"
            )
        columns.append(value.imag / _STEP)
    return np.stack(columns, axis=-1)


def _responds(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, i: int) -> bool:
    """Whether a real change of entry i is seen: additive noise is constant, and rightly real."""
    moved = x.copy()
    moved[..., i] += 1e-3 * (1.0 + np.abs(x[..., i]))
    return not np.array_equal(f(moved), f(x), equal_nan=True)


def gradient_and_hessian(
    f: Callable[[np.ndarray], np.ndarray], x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient by the complex step and Hessian by central differences of gradients.

    Args:
        f: analytic, (..., n) -> (...,).
        x: points, (..., n).

    Returns:
        (..., n), exact to rounding; (..., n, n), symmetric, to about ten digits.
    """
    n = x.shape[-1]
    h = _DIFFERENCE * (1.0 + np.abs(x))
    hessian = np.empty((*x.shape, n))
    for i in range(n):
        ahead, behind = x.copy(), x.copy()
        ahead[..., i] += h[..., i]
        behind[..., i] -= h[..., i]
        width = (ahead[..., i] - behind[..., i])[..., None]
        rise = complex_step_jacobian(f, ahead) - complex_step_jacobian(f, behind)
        hessian[..., i] = rise / width
    return complex_step_jacobian(f, x), 0.5 * (hessian + hessian.swapaxes(-1, -2))
