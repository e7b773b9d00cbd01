"""What `slipcar plan` prints: tables of iterations, horizons and guesses, and a summary."""

from __future__ import annotations

import dataclasses
from typing import Any

from slipcar.evaluation.report.layout import Fitted
from slipcar.evaluation.report.table import Field, table_of_records


def summary(found: Any, first_seconds: float) -> str:
    """What came out, in a few lines.

    Args:
        found: a plan.
        first_seconds: what the same plan took in a process that had made none.
    """
    lines = [ended(found)]
    if found.message:
        lines.append(f"  {found.message}")
    lines.append(
        f"{found.iterations} iterations in {_milliseconds(found.solve_time)} ms (the first time "
        f"{_milliseconds(first_seconds)} ms); effort {found.effort:.6f}, obstacle cost "
        f"{found.obstacle_cost:.6f}, integral of tr Σ {found.variance:.6f} "
        f"(weight {found.options['variance_weight']:g})"
    )
    if found.expected is not None:
        lines.append(_expected(found.expected))
    if found.risk is not None:
        lines.append(str(found.risk))
        alone = found.solve_time - found.risk.simulation_time
        lines.append(
            f"{len(found.risk.tried)} prices tried; {found.risk.simulation_time:.2f} s of Monte "
            f"Carlo, {_milliseconds(alone)} ms of planning"
        )
    if found.time_search:
        lines.append(
            f"final time {found.final_time:.6f} s, at {found.options['time_weight']:g} a second"
        )
    if found.shot is not None:
        lines.append(
            f"shooting: {found.shot.message}, residual {found.shot.residual:.1e} after "
            f"{found.shot.iterations} Newton steps in {_milliseconds(found.shot.seconds)} ms"
        )
    return "\n".join(lines)


def ended(found: Any) -> str:
    """How planning ended, in a sentence."""
    meaning = found.status.value.partition(": ")[2] or found.status.value
    return f"{found.status}: {meaning}"


def as_data(found: Any) -> dict[str, Any]:
    """The plan as plain data, for JSON: what came out, what it proves, and the trajectory."""
    numbers = ("effort", "obstacle_cost", "running_cost", "cost", "variance", "iterations")
    arrays = ("times", "mean", "controls", "covariance", "gains")
    return {
        "status": found.status.name,
        "message": found.message,
        **{name: getattr(found, name) for name in (*numbers, "solve_time", "final_time")},
        "expected": None if found.expected is None else dataclasses.asdict(found.expected),
        "risk": None if found.risk is None else dataclasses.asdict(found.risk),
        "residuals": None if found.expected is not None else found.certificate.residuals,
        "options": found.options,
        **{name: getattr(found, name) for name in arrays},
    }


def _expected(cost: Any) -> str:
    """One line on an expected cost."""
    goal = f", goal {cost.goal:.4f}" if cost.goal else ""
    return (
        f"expected: total {cost.total:.4f} = effort {cost.effort:.4f}, corrections "
        f"{cost.feedback:.4f}, obstacle {cost.penalty:.4f}{goal}; collision at most "
        f"{100.0 * cost.risk:.3f} % (Boole); {100.0 * cost.clipped:.2f} % of the controls clipped"
    )


def iterations_table(found: Any) -> Fitted:
    """One line an iteration."""
    fields: tuple[Field, ...] = (
        ("effort", lambda i: i.effort, ".6f"),
        ("obstacle", lambda i: i.penalty, ".6f"),
        ("∫ tr Σ dt", lambda i: i.variance, ".6f"),
        ("∫‖Δu‖² dt", lambda i: i.step, ".2e"),
        ("∫E‖Δx‖² dt", lambda i: i.trust_radius, ".2e"),
        ("virtual control", lambda i: i.virtual_control, ".1e"),
        ("|g(x(T))|", lambda i: i.terminal_residual, ".1e"),
        ("taken", lambda i: "yes" if i.accepted else "no", ""),
        ("time [ms]", lambda i: 1e3 * i.seconds, ".3f"),
    )
    return Fitted(table_of_records("iteration", fields, found.history))


def horizons_table(found: Any) -> Fitted:
    """One line a final time tried."""
    fields: tuple[Field, ...] = (
        ("final time T [s]", lambda s: s.final_time, ".6f"),
        ("cost + weight · T", lambda s: s.objective, ".6f"),
        ("slope (transversality)", lambda s: s.slope, "+.1e"),
        ("trusted ± [s]", lambda s: s.radius, ".2g"),
        ("iterations", lambda s: s.iterations, "d"),
        ("taken", lambda s: "yes" if s.accepted else "no", ""),
    )
    return Fitted(table_of_records("horizon", fields, found.time_search))


def alternatives_table(found: Any) -> Fitted:
    """One line a guess, the best first."""
    fields: tuple[Field, ...] = (
        ("guess", lambda a: a.label, ""),
        ("status", lambda a: a.status, ""),
        ("cost", lambda a: a.cost, ".6f"),
        ("way round", lambda a: "–" if a.homotopy is None else a.homotopy, ""),
        ("iterations", lambda a: a.iterations, "d"),
        ("same as", lambda a: a.same_as or "", ""),
    )
    return Fitted(table_of_records("place", fields, found.alternatives))


def _milliseconds(seconds: float) -> str:
    """Three digits below 10 ms, where most plans are."""
    ms = 1e3 * seconds
    return f"{ms:.3f}" if ms < 10.0 else f"{ms:.1f}"
