"""The default method: one LQ problem per iteration, Newton's method at the end.

In:   a checked problem (:mod:`slipcar.planner.problem`), a guess, what is charged.
Out:  an `Outcome` (plans of the mean) or a `Steered` (plans that count the noise, gains included).

:mod:`.posing` traces the problem, :mod:`.quantities` are its values and derivatives at a node,
:mod:`.equations` the iteration's equations there, :mod:`.program` makes kernels of them and the
arrays they run on, :mod:`.loop` is the iteration in plain Python, :mod:`.running` puts problems in
and takes plans out. What cannot be traced, or runs without LLVM, is filled in by NumPy
(:mod:`.filling`). Newton's method on the optimality conditions of paper §2.2; the noise of §6.2.
"""
