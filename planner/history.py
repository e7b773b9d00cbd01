"""What each step of an iteration did: rows on demand, from columns."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, overload

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One sub-problem solved and its step judged.

    Attributes:
        mean: states of the step, (N, n).
        controls: (N−1, m).
        effort: Σ dt uᵀRu.
        penalty: Σ dt Σ w max(0, c)², the obstacle cost.
        running: Σ dt (H + ℓᵀu), the other running costs.
        variance: ∫ tr Σ dt; NaN when its weight is zero (it is not computed then).
        merit: Φ there.
        predicted: decrease of Φ by the model.
        actual: decrease of Φ.
        step: ∫ ‖u_{k+1} − u_k‖² dt.
        trust_radius: ∫ E‖x − x_k‖² dt; its mean's part alone while no trust region acts.
        trust_multiplier: −p¹ with p⁰ = −1.
        virtual_control: what the sub-problem's terminal condition lacks, 1-norm.
        defect: largest |x_k + dt b(x_k, u_k) − x_{k+1}|.
        terminal_residual: largest |g(x_N)|.
        terminal_multiplier: ν, (q,).
        accepted: whether it became the next iterate.
        solver_iterations: LQ solves or the package's iterations.
        linearize_seconds: time spent on the model.
        solve_seconds: time spent in the sub-problem solver.
    """

    mean: Array
    controls: Array
    effort: float
    penalty: float
    running: float
    variance: float
    merit: float
    predicted: float
    actual: float
    step: float
    trust_radius: float
    trust_multiplier: float
    virtual_control: float
    defect: float
    terminal_residual: float
    terminal_multiplier: Array
    accepted: bool
    solver_iterations: int
    linearize_seconds: float
    solve_seconds: float

    @property
    def seconds(self) -> float:
        """Time of the iteration, callback excluded."""
        return self.linearize_seconds + self.solve_seconds


class Columns(Sequence[Iteration]):
    """A history kept as one array for each field of :class:`Iteration`, its rows first.

    The compiled iteration writes columns; most users never look at a row.

    Args:
        columns: by field, or a function that makes them when they are first looked at.
        rows: how many there are; None counts them.
    """

    def __init__(
        self, columns: dict[str, Array] | Callable[[], dict[str, Array]], rows: int | None = None
    ) -> None:
        self._columns, self._rows = columns, rows

    @property
    def columns(self) -> dict[str, Array]:
        """One array for each field, rows first."""
        if callable(self._columns):
            self._columns = self._columns()
        return self._columns

    def __reduce__(self) -> tuple[type[Columns], tuple[dict[str, Array]]]:
        return Columns, (self.columns,)

    @classmethod
    def of(cls, rows: Sequence[Iteration]) -> Columns:
        """Columns of one or more rows."""
        if isinstance(rows, Columns):
            return rows
        names = [field.name for field in dataclasses.fields(Iteration)]
        return cls({name: np.stack([getattr(row, name) for row in rows]) for name in names})

    def __len__(self) -> int:
        return len(self.columns["effort"]) if self._rows is None else self._rows

    @overload
    def __getitem__(self, index: int) -> Iteration: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Iteration, ...]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(len(self))))
        if not -len(self) <= index < len(self):
            raise IndexError(f"iteration {index} of {len(self)}")
        return Iteration(
            **{k: v[index] if v.ndim > 1 else v[index].item() for k, v in self.columns.items()}
        )
