"""The car that slips: drift and diffusion of its Itô equation, written once.

    dx = b(x, u) dt + σ(x) dB,     x = (r_x, r_y, θ, v, ω),     u = (a_v, a_ω)
    b(x, u) = (v cos θ, v sin θ, ω, a_v, a_ω)
    σ(x)    = ω v diag(α², α², β²) on (r_x, r_y, θ), zero on (v, ω)

(paper §6.3). Noise is zero when the car stands or drives straight. The part
z = (v, ω) is never reached by the noise, so in open loop it is deterministic. A scenario may add
process noise: constant columns p_i e_i, each driven by a Brownian motion of its own.

`rates` and `slip_rates` are the two equations, on components (:mod:`slipcar.envs.arrays`).
The other functions put them into arrays, batched over leading axes and following the array API:
NumPy and Torch arrays go in, the same kind comes out; so do arrays of complex numbers or symbols.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from slipcar.envs.arrays import array_namespace, stacked

#: State, control and Brownian dimensions. Slip has three non-zero rows, so three Brownian
#: motions drive it; the paper's 5 x 5 diagonal is this matrix with two zero columns dropped.
#: (Process noise, where a scenario has any, adds one for every state that it reaches.)
STATE_DIM, CONTROL_DIM, NOISE_DIM = 5, 2, 3
STATE_NAMES = ("r_x", "r_y", "θ", "v", "ω")
STATE_UNITS = ("m", "m", "rad", "m/s", "rad/s")
CONTROL_NAMES = ("a_v", "a_ω")
CONTROL_UNITS = ("m/s²", "rad/s²")


def rates(v: Any, omega: Any, cos: Any, sin: Any, a_v: Any, a_omega: Any) -> tuple[Any, ...]:
    """b(x, u) on components, given cos θ and sin θ: the drift, in one line."""
    return v * cos, v * sin, omega, a_v, a_omega


def slip_rates(v: Any, omega: Any, alpha: Any, beta: Any) -> tuple[Any, Any]:
    """ω v (α², β²) on components: the noise on either position, and on the heading, per √s.

    Args:
        v: speed [m/s].
        omega: turning rate [rad/s].
        alpha: α².
        beta: β².
    """
    product = v * omega
    return alpha * product, beta * product


def drift(x: Any, u: Any) -> Any:
    """Time derivative of the mean motion.

    Args:
        x: states, (..., 5) [m, m, rad, m/s, rad/s].
        u: controls, (..., 2) [m/s², rad/s²].

    Returns:
        b(x, u), (..., 5); paper §6.3.
    """
    xp = array_namespace(x, u)
    theta, v = x[..., 2], x[..., 3]
    b = rates(v, x[..., 4], xp.cos(theta), xp.sin(theta), u[..., 0], u[..., 1])
    return stacked(xp, b)


def drift_jacobian(x: Any, u: Any) -> tuple[Any, Any]:
    """Jacobians of :func:`drift`: ∂b/∂x (..., 5, 5) and ∂b/∂u (..., 5, 2)."""
    xp = array_namespace(x, u)
    theta, v = x[..., 2], x[..., 3]
    cos, sin = xp.cos(theta), xp.sin(theta)
    A = xp.zeros((*x.shape[:-1], STATE_DIM, STATE_DIM), dtype=x.dtype)
    A[..., 0, 2] = -v * sin
    A[..., 0, 3] = cos
    A[..., 1, 2] = v * cos
    A[..., 1, 3] = sin
    A[..., 2, 4] = 1.0
    B = xp.zeros((*x.shape[:-1], STATE_DIM, CONTROL_DIM), dtype=x.dtype)
    B[..., 3, 0] = 1.0
    B[..., 4, 1] = 1.0
    return A, B


def diffusion(x: Any, slip: Any, process: Sequence[tuple[int, float]] = ()) -> Any:
    """Diffusion matrix σ(x), (..., 5, 3 + p).

    Args:
        x: states, (..., 5).
        slip: (α², β²); see :func:`slip_rates`.
        process: p pairs (component of the state, standard deviation per √s).
    """
    xp = array_namespace(x)
    position, heading = slip_rates(x[..., 3], x[..., 4], slip[0], slip[1])
    sigma = xp.zeros((*x.shape[:-1], STATE_DIM, NOISE_DIM + len(process)), dtype=x.dtype)
    for i, scale in enumerate((position, position, heading)):
        sigma[..., i, i] = scale
    for column, (i, deviation) in enumerate(process, start=NOISE_DIM):
        sigma[..., i, column] = deviation
    return sigma


def diffusion_jacobian(x: Any, slip: Any, process: Sequence[tuple[int, float]] = ()) -> Any:
    """∂σ/∂x, (..., 5, 3 + p, 5): last axis is the state that is differentiated."""
    xp = array_namespace(x)
    columns = NOISE_DIM + len(process)
    d_sigma = xp.zeros((*x.shape[:-1], STATE_DIM, columns, STATE_DIM), dtype=x.dtype)
    for i, s in enumerate((slip[0], slip[0], slip[1])):
        d_sigma[..., i, i, 3] = s * x[..., 4]
        d_sigma[..., i, i, 4] = s * x[..., 3]
    return d_sigma
