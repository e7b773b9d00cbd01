"""The paper's method: sequential convex programming with exact convex sub-problems (§3.1, §6.4).

In goes a problem, a guess (x, u) and a solver; out comes an outcome with its history.

    :mod:`.subproblem`    LOCP_{k+1}: the problem linearised at an iterate, as arrays
    :mod:`.solvers`       its solution (d, e) and multipliers λ, ν: ours, OSQP's or cvxpy's
    :mod:`.merit`         Φ = cost + λᵀf + νᵀg + ½ max|λ| ‖f‖₁ + ½ max|ν| ‖g‖₁ judges a step
    :mod:`.trust_region`  E ∫ ‖x − x_k‖² dt ≤ Δ_k by its multiplier, and the schedules of it
    :mod:`.acceleration`  longer and combined steps where convergence is slow
    :mod:`.iteration`     linearise, solve, judge, until ∫ ‖u_{k+1} − u_k‖² dt is small twice
"""
