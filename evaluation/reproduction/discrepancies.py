"""Where the text, what was released with it and this package differ, by numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from slipcar.evaluation.reproduction.claims import percent
from slipcar.evaluation.reproduction.record import ReproductionRecord
from slipcar.evaluation.reproduction.runs import PLANS, trace_integral
from slipcar.evaluation.reproduction.variants import (
    iterations_needed,
    out_of_reach,
    printed_cost,
    released_covariance,
    released_start,
    released_trust_region,
    text_covariance,
)

#: Δ₀² / T of the release, by which it bounds every node.
_RELEASED_BOUND = 50.0**2 / 5.0


@dataclasses.dataclass(frozen=True)
class Discrepancy:
    """One line.

    Attributes:
        name: of what differs.
        text: what the text says, and what comes of it.
        released: the same of the released experiment.
        here: the same of this package.
        how: a line of Python that gives the telling number, after the preamble.
        value: that number.
    """

    name: str
    text: str
    released: str
    here: str
    how: str
    value: float


def discrepancies(r: ReproductionRecord) -> list[Discrepancy]:
    """All of them, in the order of docs/reproduction.md, and the stopping rule."""
    return [*_cost(r), _covariance(r), *_search(r)]


def _cost(r: ReproductionRecord) -> Iterator[Discrepancy]:
    s, ours = r.scenario, r.runs["ours"]
    runs = r.runs
    mine = percent(ours.result)
    potential, released = runs["printed potential"], runs["w = 0"]
    paid = printed_cost(s, potential.plan.mean)
    yield Discrepancy(
        "potential",
        f"c_o, negative inside: a plan made with it is paid for driving through obstacles (they "
        f"cost it {paid:.1f}, and our plan {printed_cost(s, ours.plan.mean):.2f}): "
        f"{percent(potential.result, 1)} collide",
        "squared",
        f"squared: {mine} collide",
        f"printed_cost(s, {PLANS['printed potential']}.mean)",
        paid,
    )
    narrow, plain = runs["clearance 0.1"], runs["clearance 0.1, w = 0"]
    yield Discrepancy(
        "clearance ε",
        f"0.1 m: {percent(narrow.result)} collide, {percent(plain.result)} without tr Σ in the "
        f"cost",
        f"0.13 m: {percent(released.result)} without tr Σ; the paper reports 6.14 %",
        f"0.13 m: {mine}",
        f"evaluate(played({PLANS['clearance 0.1, w = 0']}, s), s, {r.episodes}, {r.seed})"
        ".collision_rate",
        plain.result.collision_rate,
    )
    literal, adaptive = runs["literal"], runs["literal, adaptive"]
    recipe = r.agreement.get("released_recipe")
    yield Discrepancy(
        "first-order model of L",
        f"linear, within Δ₀ = 100, × 0.99: {literal.plan.status} after {literal.plan.iterations}, "
        f"{literal.plan.iterations - literal.clear} of the iterates go through an obstacle; of the "
        f"last, {percent(literal.result, 1)} of the paths collide",
        "not linearised: the non-convex potential goes to an NLP solver"
        + (
            f" ({100 * recipe.rate[0]:.2f} ± {100 * recipe.rate[1]:.2f} % collide, re-implemented)"
            if recipe
            else ""
        ),
        f"max(0, ·)² kept, its argument linearised: {ours.plan.status} in {ours.plan.iterations}. "
        f"The linear one in an adaptive trust region: {adaptive.plan.status} in "
        f"{adaptive.plan.iterations}, {percent(adaptive.result)} collide",
        f"evaluate(played({PLANS['literal']}, s), s, {r.episodes}, {r.seed}).collision_rate",
        literal.result.collision_rate,
    )
    yield Discrepancy(
        "variance penalty",
        f"tr Σ in the cost, weight 1: ∫ tr Σ dt = {ours.plan.variance:.5f}, {mine} collide",
        f"absent: {released.plan.variance:.5f}, {percent(released.result)}",
        "weight w, 1 by default; w = 0 is deterministic SCP",
        f"{PLANS['w = 0']}.variance",
        released.plan.variance,
    )


def _covariance(r: ReproductionRecord) -> Discrepancy:
    s, mean = r.scenario, r.runs["ours"].plan.mean
    exact = r.runs["ours"].plan.variance
    text = trace_integral(text_covariance(s, mean), s.dt)
    released = trace_integral(released_covariance(s, mean), s.dt)
    measured, error = r.moments.variance
    return Discrepancy(
        "covariance step",
        f"Σ + dt (AΣ + ΣAᵀ + C(z_k)C(z)ᵀ): ∫ tr Σ dt = {text:.5f}",
        f"σσᵀ expanded, cross terms dropped: {released:.5f}, {released / exact:.2f} times as much",
        f"A_d Σ A_dᵀ + dt σσᵀ: {exact:.5f}; {r.moments.paths:,} paths: {measured:.5f} ± "
        f"{error:.5f}",
        "trace_integral(released_covariance(s, p.mean), s.dt) / p.variance",
        released / exact,
    )


def _search(r: ReproductionRecord) -> Iterator[Discrepancy]:
    s, ours, runs = r.scenario, r.runs["ours"], r.runs
    trusted = runs["paper's trust region"].plan
    widest = max(iterate.trust_radius for iterate in trusted.history)
    largest = released_trust_region(ours.plan)
    yield Discrepancy(
        "trust region",
        f"∫ tr Σᵉ + ‖μᵉ‖² dt ≤ Δ, Δ₀ = 100, × 0.99: at most {widest:.2f}, never active",
        f"per node tr Σ + tr Σ_k + ‖μᵉ‖² ≤ Δ₀²/T = {_RELEASED_BOUND:g}, never shrunk: at most "
        f"{largest:.2f}, never active",
        "none at first; adaptive where the iteration does not settle",
        "released_trust_region(p)",
        largest,
    )
    box = runs["terminal box"].plan
    off, exact = (float(np.abs(found.mean[-1] - s.goal).max()) for found in (box, ours.plan))
    less = box.effort / ours.plan.effort - 1.0
    yield Discrepancy(
        "terminal condition",
        f"E g = 0: effort {ours.plan.effort:.4f}, off by {exact:.0e}",
        f"a box of ±10⁻³: effort {box.effort:.4f} ({100 * less:+.2f} %), off by {off:.0e}",
        "exact; the box is an option",
        f"{PLANS['terminal box']}.effort / p.effort - 1.0",
        less,
    )
    lacks = out_of_reach(s, *released_start(s))
    mine = out_of_reach(s, *s.initial_guess())
    start = runs["released start"]
    yield Discrepancy(
        "start",
        "“straight line”",
        f"θ = v = 0 along it: r_y(T) misses the goal by {lacks[1]:.2f} m whatever the control, the "
        f"first sub-problem is infeasible; relaxed, the iteration goes another way round (effort "
        f"{start.plan.effort:.2f}, {percent(start.result, 1)} collide)",
        f"with its heading and speed: nothing is out of reach ({mine.max():.0e})",
        "out_of_reach(s, *released_start(s))[1]",
        float(lacks[1]),
    )
    tight = runs["tight"].plan
    squared, not_squared = (iterations_needed(tight, squared=each) for each in (True, False))
    yield Discrepancy(
        "stopping rule",
        f"∫ ‖Δu_k‖² + ‖Δu_{{k−1}}‖² dt ≤ 10⁻³: {squared} iterations",
        f"norms not squared: {not_squared} iterations (the paper reports 10)",
        "as the text",
        f"iterations_needed({PLANS['tight']}, squared=False)",
        float(not_squared),
    )
