"""The claims of the paper's §6, each with what we get, a verdict that follows from it, and how."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from slipcar.envs.extras import install
from slipcar.evaluation.metrics import Result
from slipcar.evaluation.reproduction.record import PAPER_EPISODES, ReproductionRecord
from slipcar.evaluation.reproduction.runs import PLANS, Rate, trace_integral
from slipcar.evaluation.reproduction.variants import (
    iterations_needed,
    stopping_values,
    text_covariance,
)
from slipcar.planner import Plan

#: Verdicts. "not as printed": what the paper did is reproduced, by something else than its text.
REPRODUCED, NOT_AS_PRINTED, DIFFERS, NOT_RUN = (
    "reproduced",
    "not as printed",
    "differs",
    "not run",
)
#: What the lines under "how" take for granted; it runs in a second.
PREAMBLE = """\
import numpy as np
from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.evaluation.reproduction.claims import trace_norm
from slipcar.evaluation.reproduction.runs import (
    compared, path_moments, played, reference_file, trace_integral,
)
from slipcar.evaluation.reproduction.variants import (
    PrintedPotential, iterations_needed, out_of_reach, printed_cost, released_covariance,
    released_start, released_trust_region, stopping_values,
)
from slipcar.planner import OpenLoop, plan

s = Scenario.named("paper")
p = plan(s, method="convex")  # the paper's scheme: exact convex sub-problems"""
#: Collisions of the paper, of :data:`PAPER_EPISODES` paths; iterations of SCP.
PAPER_RATE, PAPER_ITERATIONS = 0.0614, 10
_TRUSTED = PLANS["paper's trust region"]
#: A probability within this many standard errors is not contradicted.
_SIGMAS = 1.96


@dataclasses.dataclass(frozen=True)
class Claim:
    """One claim.

    Attributes:
        name: short, of the row.
        says: the paper, in its words as far as they are short.
        here: what we get.
        verdict: one of the four above.
        how: a line of Python that gives the number, after :data:`PREAMBLE`.
        value: that number, or None where the line shows something else than a number.
    """

    name: str
    says: str
    here: str
    verdict: str
    how: str
    value: float | None = None


def percent(result: Result | Rate, digits: int = 2) -> str:
    """Collision rate with its interval."""
    low, high = result.collision_interval
    return (
        f"{100 * result.collision_rate:.{digits}f} % "
        f"[{100 * low:.{digits}f}, {100 * high:.{digits}f}]"
    )


def agrees(rate: float, paths: int, result: Result | Rate) -> bool:
    """Whether a rate seen on so many other paths may be that of the result."""
    p = result.collision_rate
    error = math.sqrt(p * (1.0 - p) * (1.0 / paths + 1.0 / result.episodes))
    return abs(rate - p) <= _SIGMAS * error


def agrees_with(expected: float, share: float, paths: int) -> bool:
    """Whether a share of so many paths is the expected one, but for a percent and chance."""
    error = math.sqrt(expected * (1.0 - expected) / paths)
    return abs(share - expected) <= 0.01 + _SIGMAS * error


def trace_norm(plan: Plan) -> float:
    """‖tr Σ_k‖ in L², the largest over the iterates of a plan."""
    scenario = plan.problem
    traces = (
        np.trace(text_covariance(scenario, iterate.mean)[1:], axis1=1, axis2=2)  # type: ignore[arg-type]
        for iterate in plan.history
    )
    return max(float(np.sqrt(np.sum(np.diff(plan.times) * trace**2))) for trace in traces)


def claims(r: ReproductionRecord) -> list[Claim]:
    """All of them, in the order of the paper."""
    return [*_scheme(r), *_problem(r), *_results(r)]


def _verdict(good: bool) -> str:
    return REPRODUCED if good else DIFFERS


def _between_paths(r: ReproductionRecord, good: bool) -> str:
    """Verdict on how paths differ: a single one does not."""
    return _verdict(good) if r.moments.paths > 1 else NOT_RUN


def _scheme(r: ReproductionRecord) -> Iterator[Claim]:
    """§6.1 and §6.2."""
    s, run, moments = r.scenario, r.runs["ours"], r.moments
    found = run.plan
    largest = float(moments.spread.max())
    many = f"path_moments(p, s, {r.episodes}, {r.seed})"
    yield Claim(
        "6.1 certain part",
        "in open loop z = (v, ω) is deterministic",
        f"largest difference between two of {moments.paths:,} paths in v or ω: {largest:.1g}",
        _between_paths(r, largest == 0.0),
        f"{many}.spread.max()",
        largest,
    )
    norm = trace_norm(found)
    yield Claim(
        "6.2 small variance",
        "‖tr Σ_k‖ in L² is much smaller than 1, so linearising at the mean is enough",
        f"at most {norm:.3f} over the {found.iterations} iterates",
        _verdict(norm < 0.1),
        "trace_norm(p)",
        norm,
    )
    predicted, (measured, error) = found.variance, moments.variance
    yield Claim(
        "6.2 moments",
        "mean and covariance of the linearised equation stand for those of the car",
        f"∫ tr Σ dt: {predicted:.5f} predicted, {measured:.5f} ± {error:.5f} over "
        f"{moments.paths:,} paths",
        _between_paths(r, abs(predicted - measured) < max(0.005 * measured, _SIGMAS * error)),
        f"{many}.variance[0]",
        measured,
    )
    yield Claim(
        "6.2 Gaussian",
        "solutions of the linearised equation are Gaussian processes",
        f"{100 * moments.inside:.1f} % of the car's paths end in the ellipse that is to hold 95 % "
        f"of them",
        _verdict(agrees_with(0.95, moments.inside, moments.paths)),
        f"{many}.inside",
        moments.inside,
    )
    last = np.abs(found.history[-1].mean - found.history[-2].mean)[:, 3:].max()
    exact = trace_integral(text_covariance(s, found.mean), s.dt)
    yield Claim(
        "6.2 C(z_k)C(z)ᵀ",
        "z_k converges, so C(z_k)C(z)ᵀ may replace C(z)C(z)ᵀ",
        f"the last step moves v, ω by at most {last:.1g}; the paper's step then gives "
        f"∫ tr Σ dt = {exact:.5f}, the exact one {predicted:.5f}",
        _verdict(last < 0.01 and abs(exact / predicted - 1.0) < 0.01),
        "np.abs(p.history[-1].mean - p.history[-2].mean)[:, 3:].max()",
        float(last),
    )
    without = r.runs["w = 0"].plan
    yield Claim(
        "6.2 tr Σ in the cost",
        "the penalty ∫ tr Σ dt forces solutions to have small variances",
        f"∫ tr Σ dt = {predicted:.5f} with it, {without.variance:.5f} without: "
        f"{100 * (predicted / without.variance - 1.0):+.1f} %",
        _verdict(predicted < without.variance),
        f"p.variance / {PLANS['w = 0']}.variance - 1.0",
        predicted / without.variance - 1.0,
    )
    yield from _solvers(r)


def _solvers(r: ReproductionRecord) -> Iterator[Claim]:
    others = {name: told for name, told in r.solvers.items() if name != "structured"}
    ran = {name: told for name, told in others.items() if "difference" in told}
    missing = [name for name in others if name not in ran]
    largest = max((told["difference"] for told in ran.values()), default=math.nan)
    names = ", ".join(["our structured solver", *ran])
    yield Claim(
        "6.2 convex solvers",
        "the sub-problems can be solved efficiently by off-the-shelf convex solvers",
        f"{names} lead to the same controls within {max(largest, 1e-8):.0e}; times are below"
        if ran
        else f"not installed: {', '.join(missing)} ({install('qp')})",
        _verdict(largest < 1e-3) if ran else NOT_RUN,
        "np.abs(plan(s, method='convex', solver='osqp').controls - p.controls).max()",
    )


def _problem(r: ReproductionRecord) -> Iterator[Claim]:
    """§6.3."""
    s, run = r.scenario, r.runs["ours"]
    printed: dict[str, Any] = {
        "start": np.zeros(5), "goal": np.array([2.2, 3.0, 0.0, 0.0, 0.0]), "horizon": 5.0,
        "slip": np.array([0.1, 0.01]), "obstacle_weight": 500.0, "nodes": 41,
    }  # fmt: skip
    wrong = [name for name, value in printed.items() if not np.array_equal(getattr(s, name), value)]
    yield Claim(
        "6.3 problem data",
        "x(0) = 0, x^f = (2.2, 3, 0, 0, 0), T = 5 s, α² = 0.1, β² = 0.01, G = ‖u‖², λ = 500, "
        "four obstacles",
        f"the same, and {len(s.obstacles)} obstacles; where they are is not printed: taken from "
        f"the released code"
        if not wrong
        else f"other values of {wrong}",
        _verdict(not wrong and len(s.obstacles) == 4),
        "s.to_dict()",
    )
    missed = float(np.abs(run.plan.mean[-1] - s.goal).max())
    off = float(np.hypot(*(r.moments.mean[-1] - s.goal)[:2]))
    yield Claim(
        "6.3 goal",
        "the goal is reached in expectation, E x(T) = x^f",
        f"the planned mean misses it by {missed:.0e}; that of {r.moments.paths:,} paths of the "
        f"non-linear equation by {1000 * off:.1f} mm",
        _verdict(missed < 1e-6 and off < 0.01),
        f"np.hypot(*(path_moments(p, s, {r.episodes}, {r.seed}).mean[-1] - s.goal)[:2])",
        off,
    )
    sigma = np.sqrt(np.maximum(np.diagonal(r.moments.covariance[-1]), 0.0))
    yield Claim(
        "6.3 uncertainty",
        "slip makes the position uncertain, actuators are certain",
        f"standard deviation at T: {sigma[0]:.3f} m, {sigma[1]:.3f} m, {sigma[2]:.3f} rad; of v "
        f"and ω {sigma[3:].max():.0g}; largest |a_v| {np.abs(run.plan.controls[:, 0]).max():.2f} "
        f"m/s²",
        _between_paths(r, min(sigma[:2]) > 0.1 and sigma[3:].max() < 1e-9),
        f"np.sqrt(path_moments(p, s, {r.episodes}, {r.seed}).covariance[-1, 0, 0])",
        float(sigma[0]),
    )
    potential = r.runs["printed potential"]
    yield Claim(
        "6.3 potential",
        "c_o = ‖r − r_o‖² − (δ_o+ε)² inside: penalises obstacles",
        f"as printed it is negative inside and rewards them: planned with it, "
        f"{percent(potential.result, 1)} of the paths collide; squared, as released and as here, "
        f"{percent(run.result)}",
        NOT_AS_PRINTED
        if potential.result.collision_rate > 2.0 * run.result.collision_rate
        else DIFFERS,
        f"evaluate(played({PLANS['printed potential']}, s), s, {r.episodes}, {r.seed})"
        ".collision_rate",
        potential.result.collision_rate,
    )
    narrow = r.runs["clearance 0.1"]
    good = agrees(PAPER_RATE, PAPER_EPISODES, run.result)
    bad = agrees(PAPER_RATE, PAPER_EPISODES, narrow.result)
    yield Claim(
        "6.3 clearance",
        "ε = 0.1",
        f"ε = 0.1 gives {percent(narrow.result)}, ε = 0.13 (released) {percent(run.result)}: only "
        f"the second {'may be' if good else 'is near'} the paper's 6.14 %",
        NOT_AS_PRINTED if good and not bad else DIFFERS,
        f"evaluate(played({PLANS['clearance 0.1']}, s), s, {r.episodes}, {r.seed}).collision_rate",
        narrow.result.collision_rate,
    )


def _results(r: ReproductionRecord) -> Iterator[Claim]:
    """§6.4 and its figure."""
    s, run = r.scenario, r.runs["ours"]
    found = run.plan
    yield Claim(
        "6.4 grid",
        "forward Euler, N = 41 nodes",
        f"{len(found.times)} nodes, {found.options['integrator']}: the mean misses its own step by "
        f"{found.history[-1].defect:.0e}",
        _verdict(len(found.times) == 41 and found.options["integrator"] == "euler"),
        "p.history[-1].defect",
        found.history[-1].defect,
    )
    trusted = r.runs["paper's trust region"].plan
    active = sum(iterate.trust_multiplier > 0.0 for iterate in trusted.history)
    widest = max(iterate.trust_radius for iterate in trusted.history)
    yield Claim(
        "6.4 trust region",
        "Δ₀ = 100, Δ_{k+1} = 0.99 Δ_k",
        f"active in {active} of {trusted.iterations} iterations; the longest step has "
        f"∫ tr Σᵉ + ‖μᵉ‖² dt = {widest:.2f}",
        _verdict(trusted.status.ok and active == 0),
        f"max(i.trust_multiplier for i in {_TRUSTED}.history)",
        max(iterate.trust_multiplier for iterate in trusted.history),
    )
    ipopt = r.agreement.get("clearance_0.13")
    yield Claim(
        "6.4 IPOPT",
        "IPOPT solves each convexified problem",
        f"our structured solver does; where SCP then converges to is where IPOPT ends with the "
        f"whole problem: controls within {ipopt.controls:.0e}, effort within "
        f"{abs(ipopt.effort):.0e}"
        if ipopt
        else "our structured solver does; the reference arrays are not here (reference=FILE)",
        NOT_RUN if ipopt is None else DIFFERS,
        "compared(s, reference_file())['clearance_0.13'].controls",
        None if ipopt is None else ipopt.controls,
    )
    values = stopping_values(found)
    yield Claim(
        "6.4 stopping rule",
        "stop when ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt ≤ 10⁻³",
        f"{values[-1]:.1e} at the last iteration, {values[-2]:.1e} at the one before",
        _verdict(values[-1] <= 1e-3 < values[-2]),
        "stopping_values(p)[-1]",
        float(values[-1]),
    )
    deepest = float(s.signed_distance(found.guess[1:]).min())
    _, u = s.initial_guess()
    defect = float(np.abs(found.guess[:-1] + s.dt * s.drift(None, found.guess[:-1], u)
                          - found.guess[1:]).max())  # fmt: skip
    yield Claim(
        "6.4 start",
        "an unfeasible straight-line initial trajectory",
        f"the straight line with its heading and speed: {1000 * -deepest:.0f} mm inside an "
        f"obstacle, its dynamics violated by {defect:.2f} (the released start is below)",
        _verdict(deepest < 0.0 < defect),
        "s.signed_distance(p.guess[1:]).min()",
        deepest,
    )
    tight = r.runs["default"].plan
    unsquared = iterations_needed(r.runs["tight"].plan, squared=False)
    yield Claim(
        "6.4 iterations",
        f"SCP converges in {PAPER_ITERATIONS} iterations",
        f"in {found.iterations} by the rule as printed, in {unsquared} by the one that was "
        f"released, with norms not squared ({tight.iterations} by Newton's method, the default)",
        _verdict(found.status.ok and found.iterations == PAPER_ITERATIONS),
        "p.iterations",
        float(found.iterations),
    )
    clear = float(s.signed_distance(found.mean[1:]).min())
    yield Claim(
        "6.4 avoidance",
        "a trajectory avoiding the obstacles in expectation",
        f"the mean keeps {clear:.3f} m from the nearest rim ({s.clearance - clear:.3f} m less than "
        f"ε: the penalty is soft)",
        _verdict(clear > 0.0),
        "s.signed_distance(p.mean[1:]).min()",
        clear,
    )
    yield Claim(
        "6.4 collisions",
        f"{100 * PAPER_RATE:.2f} % of 10⁴ sample paths intersect with obstacles",
        f"{percent(r.paper)} of as many, {percent(run.result)} of {run.result.episodes:,}; without "
        f"tr Σ in the cost, as released, {percent(r.runs['w = 0'].result)}",
        _verdict(agrees(PAPER_RATE, PAPER_EPISODES, run.result)),
        f"evaluate(OpenLoop(p), s, {PAPER_EPISODES}, {r.seed}).collision_rate",
        r.paper.collision_rate,
    )
    certificate = found.certificate
    yield Claim(
        "6.4 p⁰ ≠ 0",
        "p⁰_k ≠ 0 at every iteration and at convergence",
        f"at least |p⁰_k| = {certificate.smallest_cost_multiplier:.3f} with ‖(𝔭, p⁰, p¹)‖ = 1",
        _verdict(certificate.normal),
        "p.certificate.smallest_cost_multiplier",
        certificate.smallest_cost_multiplier,
    )
    yield Claim(
        "6.4 extremal",
        "the solution is an extremal for OCP (Theorems 3.3 and 3.4)",
        f"{'yes' if certificate.extremal else 'no'}: the conditions of the non-linear problem hold "
        f"to {certificate.residual:.1e} of their scale at the paper's tolerance "
        f"({tight.certificate.residual:.0e} by Newton's method)",
        _verdict(certificate.extremal),
        "p.certificate.residual",
        certificate.residual,
    )
    hit = int(r.paper.metrics.collision[:100].sum())
    yield Claim(
        "6.4 figure",
        "each iterate, 100 sample paths, velocities and controls",
        f"the figure iterations; {hit} of its 100 paths touch an obstacle",
        _verdict(agrees(hit / 100.0, 100, run.result)),
        "plan(s, method='convex').history",
    )
    yield Claim(
        "6.4 implementation",
        "the implementation is released (StanfordASL/stochasticSCP)",
        "read, not run: what it does otherwise than the text is in the next table",
        NOT_RUN,
        "released_covariance(s, p.mean)",
    )
