"""What is tried, an idea each: inputs drawn by hypothesis, and what must hold of each.

A check takes one input and returns findings, sentences that say what is wrong with it.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from slipcar.envs import Scenario
from slipcar.planner import Feedback, OpenLoop, Plan, RecedingHorizon, plan, plan_batch
from slipcar.planner.extremal.certificate import certify

from . import damage, ipopt, judge, options, worlds
from .calls import call
from .problems import Own, Recipe, recipes

#: Options whose numbers, or whose packages, take a problem in the units that it has.
_CONVEX = {"solver", "trust_region", "linearization", "shooting", "terminal_tolerance"}
#: Options whose numbers have units: in others they ask for something else.
_DIMENSIONAL = {
    "variance_weight", "terminal_weight", "time_weight", "risk_price", "free_final_time",
    "tolerance",
}  # fmt: skip
#: Growth of a disturbance on the way, relative to how far states move.
_ROUNDING_SEEN = 1e8
#: States beyond this lead to actions beyond float32.
LARGEST = 1e30
_BALLS = ("ball", "ball and box")


@dataclasses.dataclass(frozen=True)
class Scope:
    """How wide inputs are drawn.

    Attributes:
        kinds: structures of problems: each has to be compiled.
        seed: chooses them.
        most_intervals: of any of their time grids.
        asked: options of `plan`.
    """

    kinds: int = 120
    seed: int = 0
    most_intervals: int = 200
    asked: st.SearchStrategy[dict[str, Any]] = options.taken

    def recipes(self, kinds: int = 10**6, most_intervals: int = 10**6) -> st.SearchStrategy[Recipe]:
        """Problems of no more kinds than these, no longer than that."""
        longest = min(most_intervals, self.most_intervals)
        return recipes(min(kinds, self.kinds), self.seed, most_intervals=longest)


@dataclasses.dataclass(frozen=True)
class Idea:
    """Inputs of one sort.

    Attributes:
        inputs: scope -> strategy.
        check: an input -> findings.
        share: of all inputs of a campaign.
    """

    inputs: Callable[[Scope], st.SearchStrategy[Any]]
    check: Callable[[Any], list[str]]
    share: float


# --------------------------------------------------------------------------- problems


def problem_asked(recipe: Recipe, asked: dict[str, Any]) -> list[str]:
    """Plan a random problem and judge the plan."""
    if set(asked) & _CONVEX:
        recipe = recipe.plain
    problem = Own(recipe)
    called = call(lambda: plan(problem, **asked))
    found = list(called.findings)
    if called.error is None:
        found += judged(problem, called.value)
        found += _reached(problem, called.value)
        unitless = not set(asked) & _DIMENSIONAL and recipe.bounds not in _BALLS
        if unitless and not _charges_noise(problem, called.value):
            found += _same_elsewhere(recipe, asked, called.value)
    return found


def judged(problem: Any, p: Plan) -> list[str]:
    """A plan by the independent judge, by its own certificate, and through a file."""
    found = judge.findings(problem, p)
    if p.status.ok and p.expected is None:
        tolerance = float(np.sqrt(p.options["tolerance"]))
        certificate = call(lambda: certify(p, tolerance=tolerance))
        found += certificate.findings
        refused = certificate.error is None and not certificate.value.extremal
        if refused and not _degenerate(problem, p):
            found.append(f"CONVERGED, but {str(certificate.value).splitlines()[0]}")
    return found + _kept(p)


def _degenerate(problem: Any, p: Plan) -> bool:
    """Whether controls move fewer directions of the end than there are conditions that are met.

    Multipliers are not unique then, and the one of the cost may be as small as rounding makes it.
    """
    q, x = len(p.multipliers.terminal), p.mean[-1]
    size = np.ptp(p.mean, axis=0) + 1e-9 * np.abs(x) + 1e-300
    ends = np.stack([problem.terminal(x + 1e-6 * row) for row in np.diag(size)], axis=1)
    reach, columns = (ends - problem.terminal(x)[:, None]) / (1e-6 * size), []
    for A, B in zip(p.A[::-1], p.B[::-1], strict=True):
        columns.append(reach @ B)
        reach = reach @ A
    effect = np.concatenate(columns, axis=1)
    effect = effect / (np.abs(effect).max(axis=1, keepdims=True) + 1e-300)
    return bool(np.linalg.matrix_rank(effect, tol=1e-9) < q)


def _kept(p: Plan) -> list[str]:
    """Saved and loaded, a plan does the same."""
    with tempfile.TemporaryDirectory() as folder:
        called = call(lambda: Plan.load(p.save(Path(folder) / "plan.npz")))
    if called.error is not None or called.findings:
        return [f"saved and loaded: {called.error!r}", *called.findings]
    again = called.value
    see = np.concatenate([p.mean[len(p.mean) // 2] * 1.01, [p.times[len(p.times) // 2]]])
    found = [] if again.status is p.status else ["saved and loaded: another status"]
    if hasattr(p.problem, "decode_observation") or np.abs(p.mean).max() > LARGEST:
        return found
    for kind in (OpenLoop, Feedback):
        before, after = (call(lambda q=q, k=kind: k(q).predict(see)[0]) for q in (p, again))
        if before.findings or after.findings or repr(before.error) != repr(after.error):
            found += [f"{kind.__name__} before: {before.error!r} {before.findings}"]
            found += [f"{kind.__name__} after: {after.error!r} {after.findings}"]
        elif before.error is None and not np.array_equal(before.value, after.value):
            found.append(
                f"saved and loaded, {kind.__name__} plays {after.value} for {before.value}"
            )
    return found


def _reached(problem: Own, p: Plan) -> list[str]:
    """INFEASIBLE is refuted by IPOPT from the same guess; for linear systems by a path alone.

    (Of others it is a word about the neighbourhood, where IPOPT may end, too. Controls of tiny
    bounds move the end by less than what counts as met.)
    """
    kind = problem.recipe.kind
    euler = p.options["integrator"] == "euler"  # as the known path, and IPOPT's
    if p.status.name != "INFEASIBLE" or problem.recipe.bounds == "tiny" or not euler:
        return []
    if problem.known is not None and kind.linear:
        return ["INFEASIBLE, but a path is known that meets the end"]
    met = ipopt.meets(Own(problem.recipe.plain))
    return ["INFEASIBLE, but IPOPT meets the end"] if met else []


def _charges_noise(problem: Own, p: Plan) -> bool:
    """Whether tr Σ, which adds up states of different units, is part of the cost."""
    noisy = problem.recipe.kind.noise != "none" or hasattr(problem, "start_covariance")
    return noisy and (p.options["variance_weight"] > 0.0 or p.expected is not None)


def _same_elsewhere(recipe: Recipe, asked: dict[str, Any], p: Plan) -> list[str]:
    """The same problem where all is of order one ends alike, and costs the same.

    How an iteration fails that leads nowhere (STALLED, MAX_ITERATIONS, INFEASIBLE) may turn on
    rounding; and which way a path goes that blows it up; and whether the only controls are found
    that meet the end, all of them on their bounds.
    """
    if recipe.plain == recipe:
        return []
    plain = Own(recipe.plain)
    other = call(lambda: plan(plain, **asked))
    if other.error is not None:
        return [f"refused where all is of order one: {other.error}"]
    q, C = other.value, Own(recipe).C
    if p.status.ok is not q.status.ok:
        found = f"{p.status.name}, but {q.status.name} where all is of order one"
        return [] if plain.cornered else [found]
    if _explosive(p) or _explosive(q):
        return []
    if p.status.ok and not abs(p.cost / C - q.cost) <= 1e-3 * (abs(q.cost) + q.effort) + 1e-9:
        return [f"cost {p.cost / C:.6g}, but {q.cost:.6g} where all is of order one"]
    return []


def _explosive(p: Plan) -> bool:
    """Whether rounding of the start is seen at the end: Euler's steps of a stiff system."""
    sizes = np.ptp(p.mean, axis=0) + 1e-300
    Phi = np.eye(len(sizes))
    with np.errstate(all="ignore"):
        for A in p.A:
            Phi = A @ Phi
        return not np.abs(Phi * sizes / sizes[:, None]).max() < _ROUNDING_SEEN


# --------------------------------------------------------------------------- the rest


def option_refused(recipe: Recipe, name: str, value: Any) -> list[str]:
    """A bad value is refused, and named."""
    called = call(lambda: plan(Own(recipe), **{name: value}))
    if called.error is None:
        return [f"{name}={value!r} was taken"]
    named = [] if name in str(called.error) else [f"{name}={value!r}: {called.error!r}"]
    return [*called.findings, *named]


def batch(drawn: list[Recipe], asked: dict[str, Any]) -> list[str]:
    """A batch gives the plans that single calls give."""
    together = call(lambda: plan_batch([Own(r) for r in drawn], **asked))
    alone = [call(lambda r=r: plan(Own(r), **asked)) for r in drawn]
    found = list(together.findings)
    if together.error is not None:
        return found if any(one.error for one in alone) else [*found, repr(together.error)]
    for p, one in zip(together.value, alone, strict=True):
        if one.error is not None:
            found.append(f"alone: {one.error!r}")
        elif one.value.status is not p.status or not np.allclose(
            p.controls, one.value.controls, rtol=1e-6, atol=1e-9 * np.abs(p.controls).max()
        ):
            found.append(f"{p.status.name} in the batch is not {one.value.status.name} alone")
    return found


def receding(recipe: Recipe, asked: dict[str, Any]) -> list[str]:
    """Replanning plays admissible controls from wherever it is."""
    problem = Own(recipe)
    built = call(lambda: RecedingHorizon(problem, **asked))
    if built.error is not None:
        return list(built.findings)
    p, rng = built.value.plan, np.random.default_rng(recipe.seed)
    where = np.column_stack([p.mean[:-1], p.times[:-1]])
    where[:, :-1] *= 1.0 + 0.1 * rng.normal(size=where[:, :-1].shape)
    played = call(lambda: built.value.predict(where)[0])
    found = [*built.findings, *played.findings]
    if played.error is None:
        if not np.isfinite(played.value).all():
            found.append("an action is not finite")
        else:
            found += judge.outside(problem, np.asarray(played.value, float), part=1e-6)
    return found


def world(drawn: worlds.World, asked: dict[str, Any]) -> list[str]:
    """Plan a random world of the car and judge the plan."""
    scenario = drawn.scenario()
    called = call(lambda: plan(scenario, **asked))
    if called.error is not None:
        return list(called.findings)
    return [*called.findings, *judged(scenario, called.value)]


def world_refused(changes: dict[str, Any]) -> list[str]:
    """A scenario is made and survives a file, or is refused."""
    made = call(lambda: Scenario.named("paper").replace(**changes))
    if made.error is not None:
        return list(made.findings)
    again = call(lambda: Scenario.from_json(made.value.to_json()))
    same = again.error is None and again.value == made.value
    return [*made.findings, *([] if same else [f"through JSON: {again.error!r}"])]


IDEAS = {
    "problems": Idea(
        lambda scope: st.tuples(scope.recipes(), scope.asked),
        lambda case: problem_asked(*case),
        0.55,
    ),
    "worlds": Idea(
        lambda scope: st.tuples(worlds.worlds, scope.asked),
        lambda case: world(*case),
        0.12,
    ),
    "scenarios": Idea(lambda scope: worlds.changes, world_refused, 0.08),
    "options": Idea(
        lambda scope: st.tuples(scope.recipes(3, 10), options.refused),
        lambda case: option_refused(case[0], *case[1]),
        0.08,
    ),
    "files": Idea(lambda scope: damage.damages, damage.read_anyway, 0.08),
    "batches": Idea(
        lambda scope: st.tuples(
            st.lists(scope.recipes(20, 20), min_size=1, max_size=3),
            st.sampled_from(({}, {"variance_weight": 0.0}, {"max_iterations": 5})),
        ),
        lambda case: batch(*case),
        0.05,
    ),
    "receding": Idea(
        lambda scope: st.tuples(
            scope.recipes(20, 20),
            st.sampled_from(({}, {"iterations": 3}, {"saturation": 0.0}, {"handover": 1})),
        ),
        lambda case: receding(*case),
        0.04,
    ),
}
