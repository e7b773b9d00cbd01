"""SCP with one LQ problem per iteration: Newton's method on the optimality conditions.

See :mod:`.loop` for the method. `loop` is plain NumPy and the reference; `compiled` is the same
iteration in one numba function, for single plans and for batches; `evaluation` is what both know
about an iterate.
"""
