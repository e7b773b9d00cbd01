"""Functions to expressions to kernels: NumPy code in, values and exact derivatives out.

`trace_call` calls a user's function on arrays of symbols of a :class:`Graph` and records what it
computes; `jacobian` and `hessian` differentiate it; `numpy_function` turns expressions into code.

    graph       expressions, equal ones shared; derivatives
    arrays      arrays of expressions that NumPy code takes for arrays of numbers
    tracing     one call of a user's function; what it may not do, by name and line

Nothing here knows of planning, and nothing is needed but NumPy.
"""

from slipcar.planner.trace import linear_algebra as linear_algebra  # registers np.linalg
from slipcar.planner.trace.errors import OpaqueError, TraceError
from slipcar.planner.trace.graph import Expression, Graph, derivative, hessian, jacobian, reachable
from slipcar.planner.trace.numpy_code import numpy_function
from slipcar.planner.trace.tracing import trace_call

__all__ = [
    "Expression",
    "Graph",
    "OpaqueError",
    "TraceError",
    "derivative",
    "hessian",
    "jacobian",
    "numpy_function",
    "reachable",
    "trace_call",
]
