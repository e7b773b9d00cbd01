"""The linear-quadratic problem of one step, and its solvers.

    minimise  Σ_{k=0}^{K-1} ½ eᵀHe + hᵀe + eᵀS d  +  Σ_{k=1}^{K} ½ dᵀQd + qᵀd
    s.t.      d_{k+1} = A_k d_k + B_k e_k + f_k,    d_0 = 0,    G d_K − δ ν = s

In go the blocks of every node; out come the step (d, e), the multipliers λ_1..λ_K of the dynamics
and ν of the terminal condition. Nothing here knows where the blocks come from: a convex
sub-problem on one active set (:mod:`slipcar.planner.convex`), the Lagrangian's Hessian
(:mod:`slipcar.planner.extremal`), a step of Newton's method (:mod:`slipcar.planner.newton`).
"""
