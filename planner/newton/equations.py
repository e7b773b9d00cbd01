"""The equations of Newton's iteration, each at one node; kernels are made from them.

A *point* is a trajectory x, u with its multipliers λ, ν and what follows from it:

    evaluate   defects f, Jacobians A, B, rows c, C, end g, G; costs and what the merit needs
    backward   quadratic model of a node and its stage, one step of the Riccati recursion
    forward    the step d, e, its multipliers, bounds that it passes, what the model promises
    shift      the candidate x + α d, u + α e
    residuals  how far a point is from the maximum principle, from its dynamics and its end
    spread     covariance; rows' spread and the margins that feedback needs of the bounds
    stakes     what rows' variances are charged
    weights    P, what noise is charged, and the gains K

The mean is the special case of the belief in which rows are certain (s = 0) and only w tr Σ is
charged for noise. Rows are the problem's penalties, then its constraints where they are priced;
what a row costs is said in :mod:`slipcar.planner.moments.losses`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from slipcar.planner.lq import riccati
from slipcar.planner.moments.bridge import OVERSHOOT
from slipcar.planner.moments.losses import (
    Loss,
    floored,
    hinge_loss,
    penalty_loss,
    tail_loss,
)
from slipcar.planner.moments.propagation import (
    covariance_step,
    gain,
    noise_charge,
    noise_model,
    weight_step,
)
from slipcar.planner.newton.quantities import Dimensions, Quantities
from slipcar.planner.problem.feasibility import (
    LEAST_MOVE,
    TINY,
    control_size,
    end_sizes,
    path_sizes,
)
from slipcar.planner.trace.elementwise import choose, larger, magnitude, positive_part, within
from slipcar.planner.trace.recursion import Carried, Field, Layout, Recursion, Symmetric

Array = np.ndarray
Rows = Any  # SymbolRows or NumberRows


#: So much of the terms of a sum is rounding.
_LAST_DIGITS = 1e-14
#: What the iteration tells its kernels, entries of the row `knob`:
KNOBS = (
    "alpha",  # length of the step that `shift` takes
    "damping",  # multiple of the controls' weight R that makes the model convex
    "kappa",  # weight of ½ ‖G d + g‖² relative to how far controls of unit cost move the end
    "hinges",  # 0 leaves the rows out
    "curved",  # 1 with the curvature of dynamics, rows and end
    "clipped",  # 1 clips the controls to their bounds before the states follow
    "softness",  # of the terminal condition's system, relative
    "stiffness",  # of the bounds that are held
    "variance_weight",  # w
    "closed",  # 1 with feedback
    "saturation",  # bounds are kept at so many standard deviations of the correction
    "answered",  # 1 takes the adjoint along the paths that the step's feedback leads to
    "renewal",  # the part of a change of rows' weights that is taken over, in (0, 1]
)


class Evaluation(NamedTuple):
    """What `evaluate` says of a point.

    Attributes:
        effort: Σ dt uᵀRu.
        running: Σ dt (H + ℓᵀu).
        charged: rows, noise and a soft end, spread and weights held.
        pull: Σ λᵀf + νᵀg.
        gap: Σ |λᵀf| + √(fᵀΛf), Λ the mean of λλᵀ over the path.
        miss: Σ |ν_j g_j| of an exact end.
        defect: largest |f|.
        residual: largest |g| of an exact end.
        penalty: Σ dt Σ w max(0, c)² at the mean.
    """

    effort: float
    running: float
    charged: float
    pull: float
    gap: float
    miss: float
    defect: float
    residual: float
    penalty: float


class Model(NamedTuple):
    """What `backward` says of the model at the iterate.

    Attributes:
        bad: pivots that are not positive.
        charged: as in :class:`Evaluation`, with the weights of now.
        dearest: Σ ν_j² W_jj: what the multipliers of the end would cost as controls.
    """

    bad: float
    charged: float
    dearest: float


class Promise(NamedTuple):
    """What `forward` says of the step.

    Attributes:
        change: of the cost, by the model.
        slope: of the cost along the step.
        step: ∫ ‖Δu‖² dt.
        length: ∫ ΔuᵀRΔu dt.
        radius: ∫ ‖Δx‖² dt.
        pull: Σ λᵀf + νᵀg at the iterate.
        gap: Σ |λᵀf| + √(fᵀΛf) there.
        miss: Σ |ν_j g_j| there.
        changed: bounds that are passed and were not held, or the other way round.
        unseen: what hinges cost after the step that are off in the model.
        turned: hinges that are on after the step and off in the model, or the other way round.
        total: Σ λ: finite if all are.
    """

    change: float
    slope: float
    step: float
    length: float
    radius: float
    pull: float
    gap: float
    miss: float
    changed: float
    unseen: float
    turned: float
    total: float


class Residuals(NamedTuple):
    """What `residuals` says of a point; all dimensionless.

    Attributes:
        control: the square of how far u is from argmax_U H, relative to its own size, in the
            norm of the control's weight.
        gap: largest Σ |f_i| relative to how far x_i moves.
        end: largest |g_j| of an exact end relative to how far the states in it move.
    """

    control: float
    gap: float
    end: float


@dataclasses.dataclass(frozen=True)
class Form:
    """Which of the equations are meant.

    Attributes:
        noisy: rows are Gaussian and gains may be planned; otherwise the mean's.
        soft: the end is charged gᵀWg instead of fixed.
        tails: how many rows, the last ones, are constraints charged by their tail.
        bridged: tails are of the path between nodes: their border is nearer by what a walk that is
            looked at after every interval misses (:mod:`slipcar.planner.moments.bridge`).
    """

    noisy: bool = False
    soft: bool = False
    tails: int = 0
    bridged: bool = False


#: The other one of a pair of points has this behind the names of its arrays.
NEW = "_new"


def layout(dims: Dimensions, form: Form, own: Layout, second: Layout) -> Layout:
    """The arrays of the kernels.

    Args:
        dims: of the problem.
        form: of the equations.
        own: arrays that each point has because the problem is not traced.
        second: arrays of second derivatives of such a problem, at the iterate.
    """
    n, m, p, q = dims.n, dims.m, dims.p, dims.q
    exact = 0 if form.soft else q
    size = n + 1 + exact
    hinges = {} if form.noisy else {"on": Field((p,))}
    point = {
        "x": Field((n,)), "u": Field((m,)), "A": Field((n, n)), "B": Field((n, m)),
        "f": Field((n,)), "c": Field((p,)), "C": Field((p, n)), "g": Field((q,), True),
        "G": Field((q, n), True), "lam": Field((n,)), "nu": Field((q,), True),
        "H_xx": Field((n, n)), **hinges, **own,
    }  # fmt: skip
    fields = {
        "number": Field((dims.numbers,), True), "knob": Field((len(KNOBS),), True),
        "R": Field((m, m), True), "weight": Field((p,), True),
        "t": Field(()), "dt": Field(()), "dn": Field(()), "lower": Field((m,)),
        "upper": Field((m,)), **point, **{name + NEW: field for name, field in point.items()},
        "d": Field((n,)), "e": Field((m,)), "held": Field((m,)), "passed": Field((m,)),
        **({} if form.noisy else {"pushed": Field((p,))}),
        "V": Field((n * (n + 1) // 2 + n * (size - n),)), "law": Field((m, size)),
        "Q": Field((n, n)), "q": Field((n,)), "Rk": Field((m, m)), "rk": Field((m,)),
        "S": Field((m, n)), "costate": Field((n,)), "P": Field((n, n)), "Sigma": Field((n, n)),
        "H_psd": Field((n, n)),
        "evaluated": Field((len(Evaluation._fields),), True),
        "modelled": Field((len(Model._fields),), True),
        "promised": Field((len(Promise._fields),), True),
        "verified": Field((len(Residuals._fields),), True), "price": Field((n, n), True),
        "priced": Field((n, n), True),
        "reach": Field((q,), True), "late": Field(()), "noise": Field((), True),
    }  # fmt: skip
    if form.noisy:
        fields |= {
            "gains": Field((m, n)), "eta": Field((p,)), "wanted": Field((p,)),
            "offset": Field((p,)), "s": Field((p,)), "s_largest": Field((p,), True),
            "eta_largest": Field((), True), "W": Field((q,), True),
            "box_lower": Field((m,), True), "box_upper": Field((m,), True),
        }  # fmt: skip
    return {**fields, **second}


class Equations:
    """Recursions of one kind of problem.

    Args:
        problem: its functions and their derivatives at a node.
        form: which equations.
    """

    def __init__(self, problem: Quantities, form: Form) -> None:
        self.problem, self.form, self.dims = problem, form, problem.dims

    @property
    def recursions(self) -> list[Recursion]:
        """All of them."""
        several = [
            Recursion("evaluate", self._evaluate, self._evaluate_start, self._evaluate_end),
            Recursion("backward", self._backward, self._last, self._multiplier, descending=True),
            Recursion("forward", self._forward, self._forward_start, self._forward_end),
            Recursion("shift", self._shift, lambda rows: {}, self._shift_end),
            Recursion("rollout", self._rollout, self._rollout_start),
            Recursion(
                "residuals", self._residuals, self._residuals_start, self._residuals_end, True
            ),
            Recursion("spread", self._spread, self._spread_start, self._spread_end),
            Recursion("weights", self._weights, self._weights_start, self._weights_end, True),
        ]
        if self.form.noisy:
            several.append(Recursion("stakes", self._stakes, self._stakes_start, self._stakes_end))
        return several

    # ------------------------------------------------------------------------------ evaluate

    def _evaluate_start(self, rows: Rows) -> Carried:
        return {"sums": np.zeros(7)}

    def _evaluate(self, rows: Rows, carried: Carried) -> Carried:
        p, dt, u = self.problem.at(rows), rows["dt"], rows["u"]
        effort, running, charged, pull, gap, defect, penalty = carried["sums"]
        self._switch(rows, p.c)
        f = p.next - rows.ahead("x")
        for name, value in (("f", f), ("A", p.A), ("B", p.B), ("c", p.c), ("C", p.C)):
            rows.write(name, value)
        if p.state_cost:
            rows.write("H_xx", p.H_xx)
        row_cost, mean_cost = self._row_costs(rows, p.c)
        charge = rows.ahead("lam").dot(f)
        sums = [
            effort + dt * u.dot(rows["R"].dot(u)),
            running + dt * p.ell.dot(u) + rows["dn"] * p.H,
            charged + row_cost + noise_charge(rows["P"], p.sigma, dt),
            pull + charge,
            gap + self._detour(rows, f) + magnitude(charge),
            riccati.largest(f, defect),
            penalty + mean_cost,
        ]
        return {"sums": np.array(sums)}

    def _evaluate_end(self, rows: Rows, carried: Carried) -> None:
        p = self.problem.at(rows)
        effort, running, charged, pull, gap, defect, penalty = carried["sums"]
        self._switch(rows, p.c)
        for name, value in (("c", p.c), ("C", p.C), ("g", p.g), ("G", p.G)):
            rows.write(name, value)
        if p.state_cost:
            rows.write("H_xx", p.H_xx)
        row_cost, mean_cost = self._row_costs(rows, p.c)
        charged = charged + row_cost
        miss, residual = 0.0, 0.0
        if self.form.soft:
            charged = charged + (rows["W"] * p.g).dot(p.g)
        else:
            pull = pull + rows["nu"].dot(p.g)
            miss = magnitude(rows["nu"]).dot(magnitude(p.g))
            residual = riccati.largest(p.g, 0.0)
        evaluation = Evaluation(
            effort=effort, running=running + rows["dn"] * p.H, charged=charged, pull=pull, gap=gap,
            miss=miss, defect=defect, residual=residual, penalty=penalty + mean_cost,
        )  # fmt: skip
        rows.write("evaluated", np.array(evaluation, dtype=object))

    def _switch(self, rows: Rows, c: Array) -> None:
        """Certain rows c (p,) are on in the model where they cost something."""
        if not self.form.noisy:
            rows.write("on", choose(c, 1.0 + 0.0 * c, 0.0 * c))

    def _detour(self, rows: Rows, f: Array) -> Any:
        """What a defect f (n,) costs: the root mean square of λᵀf over the λ of the last step."""
        return np.sqrt(positive_part(f.dot(rows["price"].dot(f))))

    def _row_costs(self, rows: Rows, c: Array) -> tuple[Any, Any]:
        """What rows c (p,) are charged here, and what the penalties would be were they certain."""
        if not self.dims.p:
            return 0.0, 0.0
        certain = self.dims.p - self.form.tails
        weight = rows["weight"][:certain] * rows["dn"]
        mean = np.sum(hinge_loss(c[:certain]).value * weight)
        return (np.sum(self._loss(rows, c).value) if self.form.noisy else mean), mean

    def _loss(self, rows: Rows, c: Array) -> Loss:
        """Losses of the rows c (p,) of this node, weighed: penalties are charged per second."""
        weight, dn = rows["weight"], rows["dn"]
        if not self.form.noisy:
            return hinge_loss(c).scaled(weight * dn)
        mean, s = c + rows["offset"], floored(rows["s"], rows["s_largest"])
        k = self.dims.p - self.form.tails
        kinds = (
            penalty_loss(mean[:k], s[:k]).scaled(weight[:k] * dn),
            tail_loss(mean[k:], s[k:]).scaled(weight[k:] * choose(dn, 1.0, 0.0)),
        )
        return Loss(*(np.concatenate(parts) for parts in zip(*kinds, strict=True)))

    # ------------------------------------------------------------------------------ backward

    def _node_model(self, rows: Rows) -> tuple[Array, Array, Loss]:
        """Hessian and gradient of what is charged at a node, its rows but for their curvature."""
        p, dn, curved = self.problem.at(rows), rows["dn"], self._knob(rows, "curved")
        loss = self._loss(rows, rows["c"])
        Q = dn * (curved * p.H_xx + (1.0 - curved) * rows["H_psd"]) if p.state_cost else 0.0
        Q = Q + p.rows_hessian(curved * loss.slope) + np.zeros((self.dims.n, self.dims.n))
        q = dn * p.H_x + np.zeros(self.dims.n)
        if self.form.noisy:
            Q, q = self._with_rows(Q, q, loss, rows["C"])
        return Q, q, loss

    @staticmethod
    def _with_rows(Q: Array, q: Array, loss: Loss, C: Array) -> tuple[Array, Array]:
        """Slope and curvature of the losses, through C (p, n)."""
        for slope, bend, row in zip(loss.slope, loss.curvature, C, strict=True):
            Q, q = Q + bend * np.multiply.outer(row, row), q + slope * row
        return Q, q

    def _loaded(self, rows: Rows, Q: Array, q: Array, loss: Loss) -> tuple[Array, Array]:
        """With the hinges that are on, where rows are certain."""
        if self.form.noisy:
            return Q, q
        bend = (2.0 * self._knob(rows, "hinges") * rows["dn"]) * rows["weight"] * rows["on"]
        return self._with_rows(
            Q, q, loss._replace(slope=bend * rows["c"], curvature=bend), rows["C"]
        )

    def _last(self, rows: Rows) -> Carried:
        rows.write("price", rows["priced"])
        p, nu = self.problem.at(rows), rows["nu"]
        g, G = rows["g"], rows["G"]
        Q, q, loss = self._node_model(rows)
        multiplier = 2.0 * rows["W"] * g if self.form.soft else nu
        Q = Q + p.end_hessian(self._knob(rows, "curved") * multiplier)
        charged: Any = np.sum(loss.value)
        if self.form.soft:
            weighed = 2.0 * rows["W"][:, None] * G
            Q, q = Q + G.T.dot(weighed), q + weighed.T.dot(g)
            charged, G = charged + (rows["W"] * g).dot(g), G[:0]
        rows.write("Q", Q)
        rows.write("q", q)
        Q, q = self._loaded(rows, Q, q, loss)
        if len(G):
            reach = rows["reach"]
            kappa = choose(reach, self._knob(rows, "kappa") / reach, 0.0 * reach)
            weighed = kappa[:, None] * G
            Q, q = Q + G.T.dot(weighed), q + weighed.T.dot(g)
        return {
            "V": Symmetric(riccati.last_value(Q, q, G)), "bad": 0.0, "charged": charged,
            "reach": np.zeros(len(G)),
            "rounding": _LAST_DIGITS * magnitude(G).dot(magnitude(rows["x"])),
        }  # fmt: skip

    def _backward(self, rows: Rows, carried: Carried) -> Carried:
        p, dt, u, n = self.problem.at(rows), rows["dt"], rows["u"], self.dims.n
        V, A, B = carried["V"], rows["A"], rows["B"]
        rows.write_ahead("V", V[np.triu_indices(n, m=len(V))])
        Q, q, loss = self._node_model(rows)
        L = self._knob(rows, "curved") * p.lagrangian_hessian(rows.ahead("lam"))
        Q, q = Q + L[:n, :n], q + dt * p.d_ell.T.dot(u)
        slope, bend = noise_model(rows["P"], p.sigma, p.d_sigma, dt)
        Q, q = Q + bend, q + slope
        R, r = (2.0 * dt) * rows["R"] + L[n:, n:], (2.0 * dt) * rows["R"].dot(u) + dt * p.ell
        S = L[n:, :n]
        for name, value in (("Q", Q), ("q", q), ("Rk", R), ("rk", r), ("S", S)):
            rows.write(name, value)
        R, r = self._with_bounds(rows, R, r)
        Q, q = self._loaded(rows, Q, q, loss)
        V, law, bad = riccati.stage(V, A, B, rows["f"], Q, q, R, r, S)
        rows.write("law", law)
        charged = carried["charged"] + np.sum(loss.value) + noise_charge(rows["P"], p.sigma, dt)
        reach = choose(rows["late"], self._reached(V), carried["reach"])
        return {
            "V": Symmetric(V), "bad": carried["bad"] + bad, "charged": charged, "reach": reach,
            "rounding": carried["rounding"],
        }  # fmt: skip

    def _reached(self, V: Array) -> Array:
        """W_jj of the cost to go: how far controls of unit cost move each terminal condition."""
        return -np.diagonal(V)[self.dims.n + 1 :]

    def _with_bounds(self, rows: Rows, R: Array, r: Array) -> tuple[Array, Array]:
        """With the shift, and the bounds that are held as stiff springs."""
        held, u, weight = rows["held"], rows["u"], (2.0 * rows["dt"]) * rows["R"]
        stiffness = self._knob(rows, "stiffness") * np.diagonal(weight)
        reach = choose(held, rows["upper"] - u, choose(-held, rows["lower"] - u, 0.0 * u))
        R = R + self._knob(rows, "damping") * weight
        return R + np.eye(self.dims.m) * (stiffness * (held * held)), r - stiffness * reach

    def _multiplier(self, rows: Rows, carried: Carried) -> None:
        bad, dearest = carried["bad"], 0.0
        if not self.form.soft:
            V, softness = carried["V"], self._knob(rows, "softness")
            nu, singular = riccati.terminal_multiplier(V, rows["g"], softness, carried["rounding"])
            reach = choose(self._knob(rows, "kappa"), rows["reach"], carried["reach"])
            rows.write("reach", reach)
            bad, dearest = bad + singular, (nu * nu).dot(self._reached(V))
            rows.write("nu_new", nu)
        rows.write("modelled", np.array(Model(bad, carried["charged"], dearest), dtype=object))

    # ------------------------------------------------------------------------------- forward

    def _forward_start(self, rows: Rows) -> Carried:
        n = self.dims.n
        return {
            "d": np.zeros(n), "prices": Symmetric(np.zeros((n, n))), "sums": np.zeros(12),
        }  # fmt: skip

    def _forward(self, rows: Rows, carried: Carried) -> Carried:
        d, u, f, dt = carried["d"], rows["u"], rows["f"], rows["dt"]
        change, slope, step, length, radius, pull, gap, changed, unseen, turned, total, time = (
            carried["sums"]
        )
        more, others = self._crossed(rows, d)
        nu = rows["nu_new"][:0] if self.form.soft else rows["nu_new"]
        free = riccati.respond(rows["law"], d, nu)
        above, below = u + free - rows["upper"], rows["lower"] - u - free
        passed = choose(above, 1.0 + 0.0 * u, choose(below, -1.0 + 0.0 * u, 0.0 * u))
        inside = choose(above, rows["upper"] - u, choose(below, rows["lower"] - u, free))
        e = choose(self._knob(rows, "clipped") + 0.0 * u, inside, free)
        ahead = rows["A"].dot(d) + rows["B"].dot(e) + f
        V = self._unpacked(rows.ahead("V"), rows["law"].shape[1])
        lam = riccati.adjoint(V, ahead, nu)
        for name, value in (("d", d), ("e", inside), ("passed", passed)):
            rows.write(name, value)
        rows.write_ahead("lam_new", lam)
        charge = lam.dot(f)
        control = rows["rk"] + 0.5 * rows["Rk"].dot(inside) + rows["S"].dot(d)
        sums = [
            change + self._node_change(rows, d) + control.dot(inside),
            slope + self._node_slope(rows, d) + rows["rk"].dot(inside),
            step + dt * inside.dot(inside),
            length + dt * inside.dot(rows["R"].dot(inside)),
            radius + rows["dn"] * d.dot(d),
            pull + charge,
            gap + self._detour(rows, f) + magnitude(charge),
            changed + np.sum(magnitude(passed - rows["held"])),
            unseen + more,
            turned + others,
            total + np.sum(lam),
            time + dt,
        ]
        prices = carried["prices"] + dt * np.multiply.outer(lam, lam)
        return {"d": ahead, "prices": Symmetric(prices), "sums": np.array(sums)}

    def _forward_end(self, rows: Rows, carried: Carried) -> None:
        d, g = carried["d"], rows["g"]
        change, slope, step, length, radius, pull, gap, changed, unseen, turned, total, time = (
            carried["sums"]
        )
        more, others = self._crossed(rows, d)
        rows.write("d", d)
        rows.write("priced", carried["prices"] / time)
        miss: Any = 0.0
        if not self.form.soft:
            pull = pull + rows["nu_new"].dot(g)
            miss = magnitude(rows["nu_new"]).dot(magnitude(g))
        promise = Promise(
            change + self._node_change(rows, d), slope + self._node_slope(rows, d), step, length,
            radius + rows["dn"] * d.dot(d), pull, gap, miss, changed, unseen + more,
            turned + others, total,
        )  # fmt: skip
        rows.write("promised", np.array(promise, dtype=object))

    def _unpacked(self, upper: Array, size: int) -> Array:
        """The first n rows of a symmetric matrix, (n, size), from their upper triangle."""
        M = np.zeros((self.dims.n, size), dtype=upper.dtype)
        M[np.triu_indices(self.dims.n, m=size)] = upper
        below = np.tril_indices(self.dims.n, -1)
        M[below] = M.T[below]
        return M

    def _node_change(self, rows: Rows, d: Array) -> Any:
        """What the model says of a node's costs after a step d; certain rows keep their kink."""
        value = (rows["q"] + 0.5 * rows["Q"].dot(d)).dot(d)
        if not self.form.noisy and self.dims.p:
            c, weight = rows["c"], rows["weight"] * rows["dn"]
            after, before = positive_part(c + rows["C"].dot(d)), positive_part(c)
            value = value + weight.dot(after * after - before * before)
        return value

    def _crossed(self, rows: Rows, d: Array) -> tuple[Any, Any]:
        """Hinges after a step d: what those cost that the model has off, and how many differ."""
        if self.form.noisy or not self.dims.p:
            return 0.0, 0.0
        after, on = rows["c"] + rows["C"].dot(d), rows["on"]
        there = choose(rows["dn"], choose(after, 1.0 + 0.0 * after, 0.0 * after), on)
        rows.write("pushed", there)
        pushed = positive_part(after)
        weight = (rows["weight"] * rows["dn"]) * (1.0 - on)
        return weight.dot(pushed * pushed), np.sum(magnitude(there - on))

    def _node_slope(self, rows: Rows, d: Array) -> Any:
        """How a node's costs change with the first part of a step d."""
        value = rows["q"].dot(d)
        if not self.form.noisy and self.dims.p:
            weight = 2.0 * self._knob(rows, "hinges") * rows["weight"] * rows["dn"]
            value = value + (weight * positive_part(rows["c"])).dot(rows["C"].dot(d))
        return value

    # ------------------------------------------------------------------ candidate, the end's reach

    def _shift(self, rows: Rows, carried: Carried) -> Carried:
        alpha = self._knob(rows, "alpha")
        rows.write("x_new", rows["x"] + alpha * rows["d"])
        rows.write("u_new", rows["u"] + alpha * rows["e"])
        return {}

    def _shift_end(self, rows: Rows, carried: Carried) -> None:
        rows.write("x_new", rows["x"] + self._knob(rows, "alpha") * rows["d"])

    def _rollout_start(self, rows: Rows) -> Carried:
        rows.write("x", rows["x_new"])
        rows.write("u", self._answer(rows, rows["x_new"]))
        return {}

    def _rollout(self, rows: Rows, carried: Carried) -> Carried:
        """The path that the step's law leads to, run on the candidate's side.

        u = ū + α e + K (x − x̄ − α d) within bounds, and x follows the dynamics but for 1 − α of
        the defects that there were (Mastalli et al. 2020, feasibility-driven DDP).
        """
        lacking = 1.0 - self._knob(rows, "alpha")
        x = self.problem.at(rows).next - lacking * rows["f_new"]
        rows.write_ahead("x", x)
        rows.write_ahead("u", self._answer(rows, x, ahead=True))
        return {}

    def _answer(self, rows: Rows, x: Array, *, ahead: bool = False) -> Array:
        """The law's control at x, at this node or the next one."""
        at = rows.ahead if ahead else rows.__getitem__
        n, u, law, off = self.dims.n, at("u_new"), at("law"), x - at("x_new")
        nu = rows["nu"][:0] if self.form.soft else rows["nu"]
        steady = law[:, n] + (law[:, n + 1 :].dot(nu) if len(nu) else 0.0)
        u = u - law[:, :n].dot(off) - self._knob(rows, "alpha") * steady
        return within(u, at("lower"), at("upper"))

    # ------------------------------------------------------------------------------- residuals

    def _gradient(self, rows: Rows) -> Array:
        """Of what is charged at a node, with its rows, (n,)."""
        _, q, loss = self._node_model(rows)
        return q if self.form.noisy else self._with_rows(np.zeros(()), q, loss, rows["C"])[1]

    def _residuals_start(self, rows: Rows) -> Carried:
        n, g, G = self.dims.n, rows["g"], rows["G"]
        pull = 2.0 * rows["W"] * g if self.form.soft else rows["nu"]
        return {
            "adjoint": self._gradient(rows) + G.T.dot(pull), "off": 0.0, "size": 0.0,
            "gap": np.zeros(n), "least": rows["x"], "most": rows["x"], "terms": np.zeros(n),
            "reach": np.zeros((n, self.dims.m)),
        }  # fmt: skip

    def _residuals(self, rows: Rows, carried: Carried) -> Carried:
        """The adjoint μ, also along the paths that the last step's feedback K leads to.

            μ_k = ∇ℓ_k + A_kᵀ μ_{k+1} + K_kᵀ γ_k,    γ_k = ∂H_k/∂u

        With K it is the same where γ = 0, and bounded for unstable systems; controls at their
        bounds take no part in K.
        """
        p, dt, x, u, adjoint = (
            self.problem.at(rows), rows["dt"], rows["x"], rows["u"], carried["adjoint"],
        )  # fmt: skip
        A, B, weight = rows["A"], rows["B"], np.diagonal(rows["R"])
        slope = (2.0 * dt) * rows["R"].dot(u) + dt * p.ell + B.T.dot(adjoint)
        off = within(u - slope / ((2.0 * dt) * weight), rows["lower"], rows["upper"]) - u
        own = u + p.ell / (2.0 * weight)  # from where the control's own cost is least
        noise, _ = noise_model(rows["P"], p.sigma, p.d_sigma, dt)
        q = self._gradient(rows) + dt * p.d_ell.T.dot(u) + noise
        inside = choose(rows["upper"] - u, choose(u - rows["lower"], 1.0 + 0.0 * u, 0.0), 0.0)
        terms = magnitude(A).dot(magnitude(x)) + magnitude(B).dot(magnitude(u))
        rows.write_ahead("costate", adjoint)
        closed = self._knob(rows, "answered") * rows["law"][:, : self.dims.n]
        return {
            "adjoint": q + A.T.dot(adjoint) - closed.T.dot(inside * slope),
            "off": larger(weight.dot(off * off), carried["off"]),
            "size": larger(control_size(own, u, weight), carried["size"]),
            "gap": carried["gap"] + magnitude(rows["f"]),
            "least": -larger(-x, -carried["least"]), "most": larger(x, carried["most"]),
            "terms": larger(terms, carried["terms"]), "reach": carried["reach"] + magnitude(B),
        }  # fmt: skip

    def _residuals_end(self, rows: Rows, carried: Carried) -> None:
        sizes = path_sizes(carried["most"] - carried["least"], carried["terms"], rows["A"])
        gap, end = riccati.largest(carried["gap"] / sizes, 0.0), 0.0
        if not self.form.soft:
            end = riccati.largest(rows["g"] / end_sizes(rows["G"], sizes), end)
        pushed = carried["reach"] / sizes[:, None]
        rates = np.array([riccati.largest(column, 0.0) for column in pushed.T])
        floors = choose(rates, LEAST_MOVE / rates, 0.0)
        least = np.diagonal(rows["R"]).dot(floors * floors) + TINY
        control = carried["off"] / larger(carried["size"], least)
        rows.write("verified", np.array(Residuals(control, gap, end), dtype=object))

    # --------------------------------------------------------------------------------- belief

    def _closed_loop(self, rows: Rows) -> tuple[Array, Array]:
        """Gains K (m, n) and A + BK."""
        A, B = rows["A"], rows["B"]
        if not self.form.noisy:
            return np.zeros((self.dims.m, self.dims.n)), A
        K = rows["gains"]
        return K, A + B.dot(K)

    def _spread_start(self, rows: Rows) -> Carried:
        return {"Sigma": Symmetric(rows["Sigma"]), "largest": np.zeros(self.dims.p)}

    def _spread(self, rows: Rows, carried: Carried) -> Carried:
        p, S = self.problem.at(rows), carried["Sigma"]
        K, closed = self._closed_loop(rows)
        rows.write("Sigma", S)
        largest = carried["largest"]
        if self.form.noisy:
            largest = self._row_spread(rows, S, largest)
            spread = np.array([row.dot(S).dot(row) for row in K])
            room = 0.45 * (rows["box_upper"] - rows["box_lower"])
            margin = self._knob(rows, "saturation") * np.sqrt(positive_part(spread))
            margin = choose(room - margin, margin, room)
            rows.write("lower", rows["box_lower"] + margin)
            rows.write("upper", rows["box_upper"] - margin)
        S = covariance_step(closed, S, p.sigma, p.d_sigma, rows["dt"])
        return {"Sigma": Symmetric(S), "largest": largest}

    def _spread_end(self, rows: Rows, carried: Carried) -> None:
        S, largest = carried["Sigma"], carried["largest"]
        rows.write("Sigma", S)
        if self.form.noisy:
            rows.write("s_largest", self._row_spread(rows, S, largest))

    def _row_spread(self, rows: Rows, S: Array, largest: Array) -> Array:
        """Write ½ tr(∂²c Σ) and (C Σ Cᵀ)^½ of the rows; the largest deviations so far (p,)."""
        p, C, on = self.problem.at(rows), rows["C"], choose(rows["dn"], 1.0, 0.0)
        offset = [0.5 * np.sum(bend * S) for bend in p.row_hessians]
        if self.form.bridged:
            for i in range(self.dims.p - self.form.tails, self.dims.p):
                pushed = C[i].dot(p.sigma)
                offset[i] = offset[i] + OVERSHOOT * np.sqrt(rows["dn"] * pushed.dot(pushed))
        s = [np.sqrt(positive_part(row.dot(S).dot(row))) for row in C]
        rows.write("offset", np.array(offset, dtype=object))
        rows.write("s", np.array(s, dtype=object))
        new = [larger(on * a, b) for a, b in zip(s, largest, strict=True)]
        return np.array(new, dtype=object)

    def _stakes_start(self, rows: Rows) -> Carried:
        return {"largest": 0.0}

    def _stakes(self, rows: Rows, carried: Carried) -> Carried:
        wanted = self._loss(rows, rows["c"]).by_variance
        rows.write("wanted", wanted)
        return {"largest": riccati.largest(wanted, carried["largest"])}

    def _stakes_end(self, rows: Rows, carried: Carried) -> None:
        rows.write("eta_largest", self._stakes(rows, carried)["largest"])

    def _deviation_cost(self, rows: Rows) -> Array:
        """D: what deviations at a node are charged, (n, n)."""
        p, dn, n = self.problem.at(rows), rows["dn"], self.dims.n
        D = (self._knob(rows, "variance_weight") * dn) * np.eye(n)
        if not self.form.noisy:
            return D
        if p.state_cost:
            D = D + (0.5 * dn) * rows["H_psd"]
        eta = self._renewed(rows)
        rows.write("eta", eta)
        for weight, row in zip(eta, rows["C"], strict=True):
            D = D + weight * np.multiply.outer(row, row)
        return D

    def _renewed(self, rows: Rows) -> Array:
        """Rows' weights: tails by the factor they ask for to the power of `renewal`, (p,).

        Tails are exponential, and the whole change would overshoot.
        """
        wanted, k = rows["wanted"], self.dims.p - self.form.tails
        if not self.form.tails:
            return wanted
        share, least = self._knob(rows, "renewal"), 1e-9 * rows["eta_largest"] + 1e-30
        before, now = larger(rows["eta"][k:], least), larger(wanted[k:], least)
        mixed = np.exp((1.0 - share) * np.log(before) + share * np.log(now))
        return np.concatenate([wanted[:k], choose(rows["dn"], 1.0, 0.0) * mixed])

    def _weights_start(self, rows: Rows) -> Carried:
        D = self._deviation_cost(rows)
        if self.form.noisy:
            G = rows["G"]
            D = D + G.T.dot(rows["W"][:, None] * G)
        return {"P": Symmetric(D), "noise": 0.0}

    def _weights(self, rows: Rows, carried: Carried) -> Carried:
        p, P, dt = self.problem.at(rows), carried["P"], rows["dt"]
        A, B, R = rows["A"], rows["B"], rows["dt"] * rows["R"]
        rows.write("P", P)
        K = np.zeros((self.dims.m, self.dims.n))
        if self.form.noisy:
            K = choose(self._knob(rows, "closed"), 1.0, 0.0) * gain(A, B, P, R)
            rows.write("gains", K)
        M = weight_step(A, B, P, K, R, p.d_sigma if self.form.noisy else None, dt)
        noise = carried["noise"] + noise_charge(P, p.sigma, dt)
        return {"P": Symmetric(self._deviation_cost(rows) + M), "noise": noise}

    def _weights_end(self, rows: Rows, carried: Carried) -> None:
        rows.write("noise", carried["noise"] + np.sum(carried["P"] * rows["Sigma"]))

    def _knob(self, rows: Rows, name: str) -> Any:
        return rows["knob"][KNOBS.index(name)]
