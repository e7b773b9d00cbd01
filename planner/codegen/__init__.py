"""From a user's batched NumPy functions to machine code: trace, differentiate, compile.

    problem's functions --trace--> expression graph --derivatives--> LLVM IR --> native code

* `expression`: scalars that remember how they were computed, and their exact derivatives.
* `llvm`: straight-line native code for a list of expressions, looped over nodes.
* `traced`: the functions a planner needs from a problem, compiled and checked against it.

The physics stays written once, as array code; nothing here knows the car. Needs llvmlite, which
comes with numba.
"""
