"""How a plan ended: typed, so that no failure passes for an answer."""

from __future__ import annotations

import enum


class Status(enum.Enum):
    """Outcome of `plan`; the value is a sentence."""

    CONVERGED = "converged: the maximum principle, the dynamics and the terminal condition hold"
    MAX_ITERATIONS = "stopped at max_iterations before the controls settled"
    INFEASIBLE = "settled, but the terminal condition cannot be met (virtual control remains)"
    STALLED = "stopped: no step lowers the merit function"
    SOLVER_FAILED = "stopped: the sub-problem solver did not find a solution"
    RISK_UNREACHABLE = "settled, but no price of risk led to the risk asked for (the least is kept)"
    STOPPED = "stopped by the callback"

    def __str__(self) -> str:
        return self.name

    @property
    def ok(self) -> bool:
        """Whether the plan is a converged one."""
        return self is Status.CONVERGED
