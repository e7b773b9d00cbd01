"""What makes a plan an extremal: the discrete maximum principle, checked and solved (Thm 3.3–3.4).

In goes a trajectory (x, u) with the multiplier ν = −𝔭 of its terminal condition; out comes a
certificate (how far it is from an extremal), or the extremal near it.

    :mod:`.maximum_principle`  λ_k = ∇ℓ_k + A_kᵀλ_{k+1},  u = argmax_U H,  and scales for residuals
    :mod:`.certificate`        every condition's residual, and p⁰_k ≠ 0 along the iteration
    :mod:`.conditions`         the same as equations F(x, u, λ, ν) = 0, and Newton's step on them,
                               with second derivatives by :mod:`.second_order`
    :mod:`.shooting`           Newton's iteration from an iterate of SCP (§3.3)
"""
