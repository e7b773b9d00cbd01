"""Stochastic sequential convex programming: plans for stochastic control problems.

    from slipcar.planner import plan, OpenLoop, Feedback
    p = plan(problem)                    # any object that satisfies Problem
    action, _ = OpenLoop(p).predict(observation)

Needs NumPy and SciPy alone; the `osqp` and `cvxpy` backends import their packages when used.
"""

from slipcar.planner.controllers import Feedback, OpenLoop
from slipcar.planner.multipliers import Multipliers
from slipcar.planner.plan import Plan, plan
from slipcar.planner.problem import Problem
from slipcar.planner.scp import Iteration
from slipcar.planner.status import Status

__all__ = [
    "Feedback",
    "Iteration",
    "Multipliers",
    "OpenLoop",
    "Plan",
    "Problem",
    "Status",
    "plan",
]
