"""The structured solver's Newton iteration compiled with numba: the same steps, faster.

Problem-agnostic: it knows A, B, f, Q, q, R, r, the hinge rows and the terminal condition, not
the car. The LQ problem of an active set is solved by a Riccati recursion instead of the banded
factorisation of :mod:`.kkt`. The terminal multiplier ν enters linearly: with the cost to go

    V_k(d, ν) = ½ dᵀP d + (p + Π ν)ᵀ d + c + sᵀν − ½ νᵀW ν

one backward sweep gives s and W, and the terminal condition is the q x q system
(W + δ) ν = s − (its right-hand side).

Compiled once and cached on disk (`cache=True`); importing this module needs numba.
"""

from __future__ import annotations

import numba
import numpy as np

from slipcar.planner.convex.solvers.compiled_ball import add_spheres, move_spheres

Array = np.ndarray

_STEP_PRECISION, _WHOLE_STEPS = 1e-3, 10  # as in structured.py


@numba.njit(cache=True, fastmath=False)
def _lq(A, B, f, Q, q, R, r, G, held, softness, right, d, e, adjoint, nu):
    """Riccati recursion; writes the solution into d, e, adjoint, nu; False if it overflows."""
    K, n = f.shape
    m, t = B.shape[2], G.shape[0]
    P_all = np.empty((K, n, n))
    p_all = np.empty((K, n))
    Pi_all = np.empty((K, n, t))
    gain = np.empty((K, m, n))
    feed = np.empty((K, m))
    feed_nu = np.empty((K, m, t))
    W = np.zeros((t, t))
    s = np.zeros(t)
    P, p = Q[K - 1].copy(), q[K - 1].copy()
    Pi = np.ascontiguousarray(G.T).copy()
    H = np.empty((m, m))
    for k in range(K - 1, -1, -1):
        P_all[k], p_all[k], Pi_all[k] = P, p, Pi
        Ak, Bk, fk = A[k], B[k], f[k]
        # y = P f + p, and BᵀP.
        y = p.copy()
        for i in range(n):
            for j in range(n):
                y[i] += P[i, j] * fk[j]
        BtP = np.zeros((m, n))
        for i in range(m):
            for v in range(n):
                if Bk[v, i] != 0.0:
                    for j in range(n):
                        BtP[i, j] += Bk[v, i] * P[v, j]
        for i in range(m):
            for j in range(m):
                value = R[k, i, j]
                for v in range(n):
                    value += BtP[i, v] * Bk[v, j]
                H[i, j] = value
        # Cholesky of H, in place (lower).
        for i in range(m):
            for j in range(i + 1):
                value = H[i, j]
                for v in range(j):
                    value -= H[i, v] * H[j, v]
                if i == j:
                    if not value > 0.0:
                        return False
                    H[i, i] = np.sqrt(value)
                else:
                    H[i, j] = value / H[j, j]
        # Right-hand sides: r + Bᵀy, BᵀΠ, BᵀPA; each solved with H.
        S = np.zeros((m, 1 + t + n))
        for i in range(m):
            S[i, 0] = r[k, i]
            for v in range(n):
                b = Bk[v, i]
                if b != 0.0:
                    S[i, 0] += b * y[v]
                    for j in range(t):
                        S[i, 1 + j] += b * Pi[v, j]
                for j in range(n):
                    S[i, 1 + t + j] += BtP[i, v] * Ak[v, j]
        raw = S.copy()
        for column in range(1 + t + n):
            for i in range(m):
                value = S[i, column]
                for v in range(i):
                    value -= H[i, v] * S[v, column]
                S[i, column] = value / H[i, i]
            for i in range(m - 1, -1, -1):
                value = S[i, column]
                for v in range(i + 1, m):
                    value -= H[v, i] * S[v, column]
                S[i, column] = value / H[i, i]
        for i in range(m):
            feed[k, i] = -S[i, 0]
            for j in range(t):
                feed_nu[k, i, j] = -S[i, 1 + j]
            for j in range(n):
                gain[k, i, j] = -S[i, 1 + t + j]
        # Constants of the dual function.
        for j in range(t):
            for i in range(n):
                s[j] += Pi[i, j] * fk[i]
            for i in range(m):
                s[j] -= raw[i, 1 + j] * S[i, 0]
                for v in range(t):
                    W[j, v] += raw[i, 1 + j] * S[i, 1 + v]
        if k == 0:
            break
        # P⁻ = Q + AᵀPA − (BᵀPA)ᵀH⁻¹(BᵀPA), p⁻ = q + Aᵀy + ..., Π⁻ = AᵀΠ + ...
        PA = np.zeros((n, n))
        for i in range(n):
            for v in range(n):
                if P[i, v] != 0.0:
                    for j in range(n):
                        PA[i, j] += P[i, v] * Ak[v, j]
        newP, newp, newPi = Q[k - 1].copy(), q[k - 1].copy(), np.zeros((n, t))
        for v in range(n):
            for i in range(n):
                a = Ak[v, i]
                if a != 0.0:
                    newp[i] += a * y[v]
                    for j in range(n):
                        newP[i, j] += a * PA[v, j]
                    for j in range(t):
                        newPi[i, j] += a * Pi[v, j]
        for v in range(m):
            for i in range(n):
                w = raw[v, 1 + t + i]
                newp[i] -= w * S[v, 0]
                for j in range(n):
                    newP[i, j] -= w * S[v, 1 + t + j]
                for j in range(t):
                    newPi[i, j] -= w * S[v, 1 + j]
        for i in range(n):
            for j in range(i):
                mean = 0.5 * (newP[i, j] + newP[j, i])
                newP[i, j] = mean
                newP[j, i] = mean
        P, p, Pi = newP, newp, newPi
    # Terminal multipliers: held rows read s − W ν − δ ν = right, the others ν = right.
    if t > 0:
        for i in range(t):
            for j in range(t):
                W[i, j] = -W[i, j] if held[i] else 0.0
            W[i, i] += -softness if held[i] else 1.0
            s[i] = right[i] - s[i] if held[i] else right[i]
        nu[:] = np.linalg.solve(W, s)
    x = np.zeros(n)
    for k in range(K):
        for i in range(m):
            value = feed[k, i]
            for j in range(t):
                value += feed_nu[k, i, j] * nu[j]
            for j in range(n):
                value += gain[k, i, j] * x[j]
            e[k, i] = value
        new = f[k].copy()
        for i in range(n):
            for j in range(n):
                new[i] += A[k, i, j] * x[j]
            for j in range(m):
                new[i] += B[k, i, j] * e[k, j]
        x = new
        for i in range(n):
            value = p_all[k, i]
            for j in range(t):
                value += Pi_all[k, i, j] * nu[j]
            for j in range(n):
                value += P_all[k, i, j] * x[j]
            d[k, i] = x[i]
            adjoint[k, i] = value
            if not np.isfinite(value):
                return False
    return True


@numba.njit(cache=True, fastmath=False)
def _arguments(a, b, d, out):
    K, p, n = a.shape
    for k in range(K):
        for o in range(p):
            value = b[k, o]
            for i in range(n):
                value += a[k, o, i] * d[k, i]
            out[k, o] = value


@numba.njit(cache=True, fastmath=False)
def _objective(Q, q, R, r, h, lower, upper, stiffness, c, d, e):
    """The objective with bounds as stiff penalties, the terminal term left out."""
    K, n = d.shape
    m, p = e.shape[1], c.shape[1]
    value = 0.0
    for k in range(K):
        for i in range(m):
            inner = r[k, i]
            for j in range(m):
                inner += 0.5 * R[k, i, j] * e[k, j]
            value += inner * e[k, i]
            over = max(e[k, i] - upper[k, i], 0.0) + max(lower[k, i] - e[k, i], 0.0)
            value += 0.5 * stiffness * over * over
        for i in range(n):
            inner = q[k, i]
            for j in range(n):
                inner += 0.5 * Q[k, i, j] * d[k, j]
            value += inner * d[k, i]
        for o in range(p):
            if c[k, o] > 0.0:
                value += 0.5 * h[k, o] * c[k, o] * c[k, o]
    return value


@numba.njit(cache=True, fastmath=False)
def _line_search(Q, q, R, r, h, lower, upper, stiffness, c, d, e, c_to, d_to, e_to):
    """Step in (0, 1] that minimises `_objective` on the way from (d, e) to (d_to, e_to)."""
    K, n = d.shape
    m, p = e.shape[1], c.shape[1]
    linear, square = 0.0, 0.0
    for k in range(K):
        for i in range(m):
            de = e_to[k, i] - e[k, i]
            linear += r[k, i] * de
            for j in range(m):
                linear += e[k, j] * R[k, j, i] * de
                square += (e_to[k, j] - e[k, j]) * R[k, j, i] * de
        for i in range(n):
            dd = d_to[k, i] - d[k, i]
            linear += q[k, i] * dd
            for j in range(n):
                linear += d[k, j] * Q[k, j, i] * dd
                square += (d_to[k, j] - d[k, j]) * Q[k, j, i] * dd
    low, high, t = 0.0, 1.0, 1.0
    for trial in range(61):
        value, change = linear + t * square, square
        for k in range(K):
            for o in range(p):
                dc = c_to[k, o] - c[k, o]
                argument = c[k, o] + t * dc
                if argument > 0.0:
                    value += h[k, o] * argument * dc
                    change += h[k, o] * dc * dc
            for i in range(m):
                de = e_to[k, i] - e[k, i]
                here = e[k, i] + t * de
                over = max(here - upper[k, i], 0.0) - max(lower[k, i] - here, 0.0)
                if over != 0.0:
                    value += stiffness * over * de
                    change += stiffness * de * de
        if trial == 0:
            if value <= 0.0:
                return 1.0
            t = 0.0
            continue
        if value > 0.0:
            high = t
        else:
            low = t
        new = t - value / change if change > 0.0 else -1.0
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - t) <= _STEP_PRECISION * new:
            return new
        t = new
    return high


@numba.njit(cache=True, fastmath=False)
def newton(
    A, B, f, Q, q, R, r, a, b, h, G, g, rho, tolerance, lower, upper,
    stiffness, softness, hinge, low, high, terminal,
    center, radius, kappa, settled, sphere, turn, press, limit,
):  # fmt: skip
    """Active-set Newton from the set (hinge, low, high, terminal); see `structured._newton`.

    Arrays are those of :class:`slipcar.planner.convex.convexify.Subproblem`; the active set
    and, with balls, the spheres (on: sphere, turn, press) of :mod:`.ball` are changed in place.

    Returns:
        Whether it settled, LQ solves, d, e, adjoint, terminal multiplier.
    """
    K, n = f.shape
    m, p, t = B.shape[2], b.shape[1], g.shape[0]
    d, e, adjoint, nu = np.zeros((K, n)), np.zeros((K, m)), np.zeros((K, n)), np.zeros(t)
    d_to, e_to = np.empty((K, n)), np.empty((K, m))
    adjoint_to, nu_to = np.empty((K, n)), np.empty(t)
    c, c_to = np.empty((K, p)), np.empty((K, p))
    held, right = np.empty(t, dtype=np.bool_), np.empty(t)
    value = np.inf
    balls = radius < np.inf
    for solves in range(1, limit + 1):
        # The LQ problem of the active set.
        Qa, qa, Ra, ra = Q.copy(), q.copy(), R.copy(), r.copy()
        for k in range(K):
            for o in range(p):
                if hinge[k, o]:
                    weight = h[k, o]
                    for i in range(n):
                        w = weight * a[k, o, i]
                        if w != 0.0:
                            qa[k, i] += w * b[k, o]
                            for j in range(n):
                                Qa[k, i, j] += w * a[k, o, j]
            for i in range(m):
                if high[k, i]:
                    Ra[k, i, i] += stiffness
                    ra[k, i] -= stiffness * upper[k, i]
                elif low[k, i]:
                    Ra[k, i, i] += stiffness
                    ra[k, i] -= stiffness * lower[k, i]
        if balls:
            add_spheres(Ra, ra, center, radius, kappa, sphere, turn, press)
        for j in range(t):
            held[j] = abs(terminal[j]) == 1
            if held[j]:
                right[j] = np.sign(terminal[j]) * tolerance - g[j]
            else:
                right[j] = terminal[j] // 2 * rho
        if not _lq(
            A, B, f, Qa, qa, Ra, ra, G, held, softness, right, d_to, e_to, adjoint_to, nu_to
        ):
            return False, solves, d, e, adjoint, nu
        _arguments(a, b, d_to, c_to)
        target_value = _objective(Q, q, R, r, h, lower, upper, stiffness, c_to, d_to, e_to)
        step = 1.0
        if solves > _WHOLE_STEPS and target_value > value and not balls:
            step = _line_search(Q, q, R, r, h, lower, upper, stiffness, c, d, e, c_to, d_to, e_to)
        if solves == 1 or step > 1.0 - 1e-10:
            step, value = 1.0, target_value
            d[:], e[:], adjoint[:], nu[:], c[:] = d_to, e_to, adjoint_to, nu_to, c_to
        else:
            d += step * (d_to - d)
            e += step * (e_to - e)
            adjoint += step * (adjoint_to - adjoint)
            nu += step * (nu_to - nu)
            _arguments(a, b, d, c)
            value = _objective(Q, q, R, r, h, lower, upper, stiffness, c, d, e)
        # The pieces it lies on.
        same = True
        for k in range(K):
            for o in range(p):
                on = c[k, o] > 0.0
                same = same and on == hinge[k, o]
                hinge[k, o] = on
            for i in range(m):
                below, above = e[k, i] < lower[k, i], e[k, i] > upper[k, i]
                same = same and below == low[k, i] and above == high[k, i]
                low[k, i], high[k, i] = below, above
        if balls and not move_spheres(e, R, center, radius, kappa, settled, sphere, turn, press):
            same = False
        if tolerance > 0.0:
            for j in range(t):
                old = terminal[j]
                if held[j]:
                    if nu[j] * old < 0.0:
                        terminal[j] = -old
                elif old == 0:
                    residual = g[j]
                    for i in range(n):
                        residual += G[j, i] * d[K - 1, i]
                    if residual > tolerance:
                        terminal[j] = 1
                    elif residual < -tolerance:
                        terminal[j] = -1
                same = same and terminal[j] == old
        if step == 1.0 and same:
            return True, solves, d, e, adjoint, nu
    return False, limit, d, e, adjoint, nu
