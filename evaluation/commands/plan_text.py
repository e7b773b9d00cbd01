"""What `slipcar plan` prints: tables of iterations, horizons and guesses, and a summary."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

#: Header and the cell of a row.
Column = tuple[str, Callable[[Any], str]]


def summary(found: Any, first_seconds: float) -> str:
    """What came out, in a few lines.

    Args:
        found: a plan.
        first_seconds: what the same plan took in a process that had made none.
    """
    meaning = found.status.value.partition(": ")[2] or found.status.value
    lines = [f"{found.status}: {meaning}"]
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


def _expected(cost: Any) -> str:
    """One line on an expected cost."""
    goal = f", goal {cost.goal:.4f}" if cost.goal else ""
    return (
        f"expected: total {cost.total:.4f} = effort {cost.effort:.4f}, corrections "
        f"{cost.feedback:.4f}, obstacle {cost.penalty:.4f}{goal}; collision at most "
        f"{100.0 * cost.risk:.3f} % (Boole)"
    )


def iterations_table(found: Any) -> Table:
    """One line an iteration."""
    columns: tuple[Column, ...] = (
        ("effort", lambda i: f"{i.effort:.6f}"),
        ("obstacle", lambda i: f"{i.penalty:.6f}"),
        ("∫ tr Σ dt", lambda i: f"{i.variance:.6f}" if i.variance == i.variance else "–"),
        ("∫‖Δu‖² dt", lambda i: f"{i.step:.2e}"),
        ("∫E‖Δx‖² dt", lambda i: f"{i.trust_radius:.2e}"),
        ("virtual control", lambda i: f"{i.virtual_control:.1e}"),
        ("|g(x(T))|", lambda i: f"{i.terminal_residual:.1e}"),
        ("taken", lambda i: "yes" if i.accepted else "no"),
        ("time [ms]", lambda i: _milliseconds(i.seconds)),
    )
    return _table("iteration", columns, found.history)


def horizons_table(found: Any) -> Table:
    """One line a final time tried."""
    columns: tuple[Column, ...] = (
        ("final time T [s]", lambda s: f"{s.final_time:.6f}"),
        ("cost + weight · T", lambda s: f"{s.objective:.6f}"),
        ("slope (transversality)", lambda s: f"{s.slope:+.1e}"),
        ("trusted ± [s]", lambda s: f"{s.radius:.2g}"),
        ("iterations", lambda s: str(s.iterations)),
        ("taken", lambda s: "yes" if s.accepted else "no"),
    )
    return _table("horizon", columns, found.time_search)


def alternatives_table(found: Any) -> Table:
    """One line a guess, the best first."""
    columns: tuple[Column, ...] = (
        ("guess", lambda a: a.label),
        ("status", lambda a: str(a.status)),
        ("cost", lambda a: f"{a.cost:.6f}"),
        ("way round", lambda a: "–" if a.homotopy is None else str(a.homotopy)),
        ("iterations", lambda a: str(a.iterations)),
        ("same as", lambda a: a.same_as or ""),
    )
    return _table("place", columns, found.alternatives, left=("guess", "status", "same as"))


def _table(
    number: str, columns: Iterable[Column], rows: Iterable[Any], left: Iterable[str] = ()
) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column(number, justify="right")
    columns, left = tuple(columns), tuple(left)
    for header, _ in columns:
        table.add_column(Text(header), justify="left" if header in left else "right")
    for place, row in enumerate(rows, start=1):
        table.add_row(str(place), *(Text(cell(row)) for _, cell in columns))
    return table


def _milliseconds(seconds: float) -> str:
    """Three digits below 10 ms, where most plans are."""
    ms = 1e3 * seconds
    return f"{ms:.3f}" if ms < 10.0 else f"{ms:.1f}"
