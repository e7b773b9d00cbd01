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

from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model, checked_trajectory
from slipcar.planner.records import Alternative
from slipcar.planner.search.tasks import Task, solve_tasks

Array = np.ndarray

#: Two plans are the same answer if their class is and their objectives differ by less than this
#: part; without classes, if their controls do, in the norm of the effort.
_SAME = 1e-3
#: Standard deviation of a bump's two half waves, in parts of the path's extent.
_BUMP = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Guess:
    """Where to start.

    Attributes:
        label: what it is, for people.
        states: (N, n).
        controls: (N−1, m).
        free_first: whether to plan without penalties first.
    """

    label: str
    states: Array
    controls: Array
    free_first: bool = False


def initial_guesses(model: Model, count: int) -> list[Guess]:
    """Up to `count` guesses, the most promising first; the problem's own is the first.

    Where there are penalties it is there twice, without them first and as it is.

    Args:
        model: the completed problem.
        count: at least 1. Fewer come back only if the problem offers fewer. An optional member
            `guesses(count)` of the problem gives (label, states (N, n), controls (N−1, m)), the
            most promising first.

    Returns:
        Guesses that start at `start`, with controls within bounds; the same call gives the same.

    Raises:
        ValueError: if what `problem.guesses` gives is wrong.
    """
    x, u = model.guess()
    found = [Guess("own", x, u, free_first=True)]
    if model.weight.any():
        found.append(Guess("own, penalties in", x, u))
        count += 1  # the own one counts once, though it is tried both ways
    for label, states, controls in _others(model, x, u, int(count)):
        if len(found) >= count:
            break
        guess = Guess(label, *checked_trajectory(model, states, controls))
        if not np.array_equal(guess.states, x):  # the own one again
            found.append(guess)
    return found[:count]


@dataclasses.dataclass(frozen=True, eq=False)
class Starts:
    """What several guesses led to.

    Attributes:
        different: outcomes that are not the same answer, each with the states (N, n) of the guess
            that led there, the best first.
        alternatives: all that was tried, the best first; the same answers are marked.
    """

    different: tuple[tuple[Array, Outcome], ...]
    alternatives: tuple[Alternative, ...]


def multistart(model: Model, posed: Posed | None, options: Options, count: int) -> Starts:
    """Plan from several guesses, all at once where that is possible."""
    guesses = initial_guesses(model, count)
    tasks = [Task(model, posed, g.states, g.controls, g.free_first) for g in guesses]
    # One thread: several would not pay for a handful of problems.
    outcomes = solve_tasks(tasks, options, workers=1, label="guess {}")
    order = sorted(range(len(guesses)), key=lambda i: _rank(outcomes[i]))
    classify = getattr(model.problem, "homotopy_class", None)
    rows: list[Alternative] = []
    different: list[int] = []  # of the answers above, the first of its kind
    for i in order:
        outcome = outcomes[i]
        row = Alternative(
            label=guesses[i].label,
            status=outcome.status,
            cost=outcome.objective,
            homotopy=None if classify is None else classify(outcome.x),
            iterations=outcome.iterations,
        )
        twin = next((j for j in different if _same(model, rows, order, outcomes, j, row, i)), None)
        if twin is None:
            different.append(i)
        else:
            row = dataclasses.replace(row, same_as=guesses[twin].label)
        rows.append(row)
    return Starts(
        different=tuple((guesses[i].states, outcomes[i]) for i in different),
        alternatives=tuple(rows),
    )


def _others(model: Model, x: Array, u: Array, count: int) -> Iterator[tuple[str, Array, Array]]:
    """What the problem offers, else bumps along which its functions are finite."""
    offered = getattr(model.problem, "guesses", None)
    if offered is not None:
        yield from offered(count)
        return
    for number, path in enumerate(itertools.islice(_bumps(model, x), 5 * count), start=1):
        if _finite_along(model, path, u):
            yield f"bump {number}", path, u


def _bumps(model: Model, x: Array) -> Iterator[Array]:
    """Endless smooth perturbations of a path (N, n), of its own size, ends kept; each both ways."""
    rng = np.random.default_rng(0)
    spread = np.ptp(x, axis=0)
    size = np.where(spread > 0.0, spread, np.maximum(np.max(np.abs(x), axis=0), 1.0))
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


def _rank(found: Outcome) -> tuple[bool, float, float]:
    """Converged ones first, by objective; the others by what they miss, then by objective."""
    worth = found.objective if math.isfinite(found.objective) else math.inf
    if found.status.ok:
        return (False, 0.0, worth)
    missed = found.history[-1].terminal_residual if len(found.history) else math.inf
    return (True, missed if math.isfinite(missed) else math.inf, worth)


def _same(
    model: Model,
    rows: list[Alternative],
    order: list[int],
    outcomes: list[Outcome],
    j: int,
    row: Alternative,
    i: int,
) -> bool:
    """Whether guess i, with this row, led to the answer of guess j."""
    other = rows[order.index(j)]
    if other.status is not row.status or other.homotopy != row.homotopy:
        return False
    if row.homotopy is not None:
        return abs(other.cost - row.cost) <= _SAME * max(abs(other.cost), abs(row.cost))
    dt = model.dt[:, None]
    apart = float(np.sum(dt * (outcomes[i].u - outcomes[j].u) ** 2))
    return apart <= _SAME**2 * float(np.sum(dt * outcomes[j].u ** 2))
