"""The LQ problem by generated code (:mod:`slipcar.planner.newton.recursion`), or by loops."""

from __future__ import annotations

import numba
import numpy as np

from slipcar.planner.newton.native import call
from slipcar.planner.newton.riccati import SOFTNESS, solve_symmetric


@numba.njit(error_model="numpy")
def sweep(
    addresses, A, B, f, Q_nodes, q_nodes, R, r, S, G, g, gramian, V, gain, pivot, d_nodes, e,
    adjoint, nu,
):  # fmt: skip
    """:func:`.riccati.solve_lq` by generated code: see `codegen.recursion`."""
    K, n = f.shape
    m, t = e.shape[1], len(nu)
    # Cost to go of the last node: ½ dᵀQd + qᵀd + νᵀG d, upper triangle in (d, 1, ν).
    place = 0
    for i in range(n + 1 + t):
        for j in range(i, n + 1 + t):
            value = 0.0
            if i < n:
                if j < n:
                    value = Q_nodes[K, i, j]
                elif j == n:
                    value = q_nodes[K, i]
                else:
                    value = G[j - n - 1, i]
            V[K, place] = value
            place += 1
    call(
        addresses[6],
        (
            K, A.ctypes.data, B.ctypes.data, f.ctypes.data, Q_nodes.ctypes.data,
            q_nodes.ctypes.data, R.ctypes.data, r.ctypes.data, S.ctypes.data, V.ctypes.data,
            V.ctypes.data, gain.ctypes.data, pivot.ctypes.data,
        ),
    )  # fmt: skip
    for k in range(K):
        for i in range(m):
            if not pivot[k, i] > 0.0:
                return False
    if t > 0:
        W, s = np.empty((t, t)), np.empty(t)
        for i in range(t):
            row = n + 1 + i
            start = row * (n + 1 + t) - row * (row - 1) // 2  # of the packed row
            for j in range(i, t):
                W[i, j] = -V[0, start + j - i]
                W[j, i] = W[i, j]
            constant = n * (n + 1 + t) - n * (n - 1) // 2
            s[i] = V[0, constant + 1 + i] + g[i]
        for i in range(t):
            W[i, i] += SOFTNESS * gramian
        if not solve_symmetric(W, s):
            return False
        nu[:] = s
    d_nodes[0] = 0.0
    call(
        addresses[7],
        (
            K, A.ctypes.data, B.ctypes.data, f.ctypes.data, gain.ctypes.data, V.ctypes.data,
            nu.ctypes.data, d_nodes.ctypes.data, e.ctypes.data, d_nodes.ctypes.data,
            adjoint.ctypes.data,
        ),
    )  # fmt: skip
    total = 0.0
    for k in range(K):
        for i in range(n):
            total += adjoint[k, i]
    return np.isfinite(total)
