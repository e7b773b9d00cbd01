"""Solvers of the sub-problem behind one small interface, `solve(subproblem) -> Solution`.

* `structured` (default): semismooth Newton on banded LQ problems, exact, no QP package.
* `osqp`: first-order method for any sparse QP, updated in place.
* `cvxpy`: the sub-problem in a page, any cone solver; slow, readable, the tests' oracle.

:mod:`.interface` says what a solver is, :mod:`.registry` finds one by its name.
"""
