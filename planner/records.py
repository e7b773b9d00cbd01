"""What a plan tells of how it was found: iterations, multipliers, what else was tried."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from typing import Any, overload

import numpy as np

from slipcar.planner.display import brief
from slipcar.planner.status import Status

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One sub-problem solved and its step judged."""

    mean: Array  #: states of the step, (N, n)
    controls: Array  #: (N−1, m)
    effort: float  #: Σ dt uᵀRu
    penalty: float  #: Σ dt Σ w max(0, c)², the obstacle cost
    running: float  #: Σ dt (H + ℓᵀu), the other running costs
    variance: float  #: ∫ tr Σ dt; NaN when its weight is zero (it is not computed then)
    merit: float  #: Φ there
    predicted: float  #: decrease of Φ by the model
    actual: float  #: decrease of Φ
    step: float  #: ∫ ‖u_{k+1} − u_k‖² dt
    trust_radius: float  #: ∫ E‖x − x_k‖² dt, in units of the problem's size where the trust
    #: region is adaptive; its mean's part alone while no trust region acts
    trust_multiplier: float  #: −p¹ with p⁰ = −1
    virtual_control: float  #: what the sub-problem's terminal condition lacks, 1-norm
    defect: float  #: largest |x_k + dt b(x_k, u_k) − x_{k+1}|
    terminal_residual: float  #: largest |g(x_N)|
    terminal_multiplier: Array  #: ν, (q,)
    accepted: bool  #: whether it became the next iterate
    solver_iterations: int  #: LQ solves or the package's iterations
    linearize_seconds: float  #: time spent on the model
    solve_seconds: float  #: time spent in the sub-problem solver

    __repr__ = brief

    @property
    def seconds(self) -> float:
        """Time of the iteration, callback excluded."""
        return self.linearize_seconds + self.solve_seconds


class Columns(Sequence[Iteration]):
    """A history kept as one array for each field of :class:`Iteration`, its rows first.

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

    def __repr__(self) -> str:
        return f"<{len(self)} iterations>"

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


@dataclasses.dataclass(frozen=True)
class Multipliers:
    """Pontryagin multipliers (Theorems 3.1 and 3.2): H = pᵀb + p⁰f⁰ is maximised by u.

    The sub-problem's own multipliers are gradients of a cost that is minimised; the paper's
    have the opposite sign. They are as solved, with p⁰ = −1; see :meth:`normalized`.
    """

    terminal: Array  #: 𝔭, (q,)
    cost: float  #: p⁰ ≤ 0
    trust_region: float  #: p¹ ≤ 0
    adjoint: Array  #: p at every node, (N, n)

    __repr__ = brief

    @classmethod
    def of(cls, adjoint: Array, terminal: Array, trust_multiplier: float, A: Array) -> Multipliers:
        """From λ_1..λ_K (K, n), ν (q,) and the trust region's weight of a sub-problem."""
        # λ_0 follows from the adjoint equation at node 0, where no cost is charged.
        p = np.empty((len(adjoint) + 1, adjoint.shape[1]))
        np.negative(adjoint, out=p[1:])
        p[0] = A[0].T @ p[1]
        return cls(-terminal, -1.0, -trust_multiplier, p)

    def normalized(self) -> Multipliers:
        """Scaled so that (𝔭, p⁰, p¹) has norm one."""
        whole = np.append(self.terminal, [self.cost, self.trust_region])
        largest = float(np.abs(whole).max())  # whose square may overflow
        scale = largest * float(np.linalg.norm(whole / largest))
        return Multipliers(**{name: value / scale for name, value in vars(self).items()})

    def as_dict(self) -> dict[str, Array]:
        """Arrays by name, for a file."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def from_dict(cls, data: dict[str, Array]) -> Multipliers:
        """What :meth:`as_dict` gave."""
        numbers = {name: float(data[name]) for name in ("cost", "trust_region")}
        return cls(terminal=data["terminal"], adjoint=data["adjoint"], **numbers)


@dataclasses.dataclass(frozen=True)
class Alternative:
    """What one of several guesses led to."""

    label: str  #: the guess's
    status: Status  #: how it ended
    cost: float  #: effort + penalties + running cost + w ∫ tr Σ dt
    #: `problem.homotopy_class` of its mean; None if the problem has no such member
    homotopy: Hashable | None
    iterations: int  #: sub-problems solved
    #: label of a better-placed alternative that is the same answer, or None
    same_as: str | None = None

    __repr__ = brief


@dataclasses.dataclass(frozen=True)
class TimeStep:
    """One horizon tried."""

    final_time: float  #: T [s]
    objective: float  #: V(T) + c T
    slope: float  #: V′(T) + c, the transversality residual; NaN if the plan did not converge
    radius: float  #: Δ it was within [s]
    accepted: bool  #: whether it became the best
    iterations: int  #: sub-problems solved


@dataclasses.dataclass(frozen=True)
class ExpectedCost:
    """What a plan costs in expectation, for Gaussian states (linearised moments)."""

    effort: float  #: Σ dt ūᵀRū
    feedback: float  #: Σ dt tr(K Σ Kᵀ R), the effort of the corrections
    running: float  #: E Σ dt (H + ℓᵀu)
    penalty: float  #: E Σ dt Σ w max(0, c)²
    goal: float  #: E gᵀWg; 0 where the terminal condition is exact and its spread not charged
    #: Σ Φ(h/s) over nodes and constraints, at most 1: Boole's bound of the probability of any
    #: violation
    risk: float
    #: part of all K m controls that the feedback asks for beyond their bounds, where they are
    #: clipped, which the moments do not know of
    clipped: float = 0.0

    @property
    def total(self) -> float:
        """All but the risk."""
        return self.effort + self.feedback + self.running + self.penalty + self.goal
