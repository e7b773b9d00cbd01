"""Several guesses, the best plan: which way round the obstacles is a question for enumeration.

    guesses: the problem's own, without penalties first and with them; then what the problem offers
             (`problem.guesses`), else smooth random bumps of its own
    answer:  of the converged outcomes the one of least cost + w ∫ tr Σ dt

SCP finds local optima. With obstacles there is one, often more, for each way round them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator

import numpy as np

from slipcar.planner.convex.units import natural_units
from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model, checked_trajectory
from slipcar.planner.records import Alternative
from slipcar.planner.search.attempt import Task, attempt
from slipcar.planner.search.tasks import naming

Array = np.ndarray

#: Two plans are the same answer if their class is and their objectives differ by less than this
#: part; without classes, if their controls do, in the norm of the effort.
_SAME = 1e-3
#: Standard deviation of a bump's two half waves, in parts of the path's extent.
_BUMP = 0.5


def initial_guesses(model: Model, count: int, posed: Posed | None = None) -> list[Task]:
    """Up to `count` ≥ 1 guesses, the most promising first; the problem's own is the first.

    Where there are penalties it is there twice, without them first and as it is. Fewer come back
    only if the problem offers fewer: an optional member `guesses(count)` of the problem gives
    (label, states (N, n), controls (N−1, m)), the most promising first. All begin at `start`, with
    controls within bounds; the same call gives the same.

    Raises:
        ValueError: if what `problem.guesses` gives is wrong.
    """
    x, u = model.guess()
    guesses = [Task(model, posed, x, u, free_first=True, label="own")]
    if model.weight.any():
        guesses.append(Task(model, posed, x, u, label="own, penalties in"))
        count += 1  # the own one counts once, though it is tried both ways
    for label, states, controls in _others(model, x, u, int(count)):
        if len(guesses) >= count:
            break
        guess = checked_trajectory(model, states, controls)
        if not np.array_equal(guess[0], x):  # the own one again
            guesses.append(Task(model, posed, *guess, label=label))
    return guesses[:count]


def multistart(
    model: Model, posed: Posed | None, options: Options, count: int
) -> tuple[list[tuple[Array, Outcome]], tuple[Alternative, ...]]:
    """Plan from several guesses, one after the other: threads would not pay for a handful.

    Returns:
        Outcomes that are not the same answer, each with the states (N, n) of the guess that led
        there, the best first; and what became of every guess, the same answers marked.
    """
    outcomes: list[tuple[Task, Outcome]] = []
    for i, task in enumerate(initial_guesses(model, count, posed)):
        with naming(f"guess {i}"):
            outcomes.append((task, attempt(task, options)))
    classify = getattr(model.problem, "homotopy_class", None) or (lambda x: None)
    # Bold steps may leave the way of their guess: where no plan goes it, judged ones keep to it.
    gone = {classify(outcome.x) for _, outcome in outcomes}
    for task, _ in tuple(outcomes):
        if task.posed is not None and (way := classify(task.x)) not in gone:
            label = f"{task.label}, judged"
            kept = dataclasses.replace(task, free_first=False, judged=True, label=label)
            outcomes.append((kept, attempt(kept, options)))
            gone |= {way, classify(outcomes[-1][1].x)}
    outcomes.sort(key=lambda pair: _rank(pair[1]))
    rows: list[Alternative] = []
    different: list[tuple[Alternative, Array, Outcome]] = []
    for task, new in outcomes:
        kind = classify(new.x)
        row = Alternative(task.label, new.status, new.objective, kind, new.iterations)
        twins = (known for known, _, other in different if _same(model, known, other, row, new))
        if (twin := next(twins, None)) is None:
            different.append((row, task.x, new))
        else:
            row = dataclasses.replace(row, same_as=twin.label)
        rows.append(row)
    return [(states, outcome) for _, states, outcome in different], tuple(rows)


def _others(model: Model, x: Array, u: Array, count: int) -> Iterator[tuple[str, Array, Array]]:
    """What the problem offers, else bumps along which its functions are finite."""
    offered = getattr(model.problem, "guesses", None)
    if offered is not None:
        yield from offered(count)
        return
    for number, path in enumerate(itertools.islice(_bumps(model, x, u), 5 * count), start=1):
        if _finite_along(model, path, u):
            yield f"bump {number}", path, u


def _bumps(model: Model, x: Array, u: Array) -> Iterator[Array]:
    """Endless smooth perturbations of a path (N, n), of its own size, ends kept; each both ways."""
    rng = np.random.default_rng(0)
    spread = np.ptp(x, axis=0)
    size = np.where(spread > 0.0, spread, natural_units(model, x, u, box=False).state)
    s = (model.times - model.times[0]) / (model.times[-1] - model.times[0])
    waves = np.sin(np.pi * np.outer(s, [1.0, 2.0]))
    while True:
        bump = waves @ rng.normal(0.0, _BUMP, (2, len(size))) * size
        yield x + bump
        yield x - bump


def _finite_along(model: Model, x: Array, u: Array) -> bool:
    """Whether the model's functions can be evaluated along a path."""
    t = model.times
    with np.errstate(all="ignore"):
        values = (
            model.drift(t[:-1], x[:-1], u),
            model.diffusion(t[:-1], x[:-1]),
            model.penalty(t, x),
            model.terminal(x[-1:]),
        )
    return all(bool(np.isfinite(value).all()) for value in values)


def _rank(outcome: Outcome) -> tuple[bool, float, float]:
    """Converged ones first, by objective; the others by what they miss, then by objective."""
    worth = outcome.objective if math.isfinite(outcome.objective) else math.inf
    if outcome.status.ok:
        return (False, 0.0, worth)
    missed = outcome.history[-1].terminal_residual if len(outcome.history) else math.inf
    return (True, missed if math.isfinite(missed) else math.inf, worth)


def _same(model: Model, known: Alternative, best: Outcome, row: Alternative, new: Outcome) -> bool:
    """Whether a new outcome, with its row, is the answer that is known."""
    if known.status is not row.status or known.homotopy != row.homotopy:
        return False
    if row.homotopy is not None:
        return abs(known.cost - row.cost) <= _SAME * max(abs(known.cost), abs(row.cost))
    dt = model.dt[:, None]
    apart = float(np.sum(dt * (new.u - best.u) ** 2))
    return apart <= _SAME**2 * float(np.sum(dt * best.u**2))
