"""Functions to expressions to kernels: NumPy code in, values and exact derivatives out.

    graph       expressions, equal ones shared; derivatives: what they are made of, and jacobian
    arrays      arrays of expressions that NumPy code takes for arrays of numbers
    tracing     one call of a user's function; what it may not do, by name and line
    recursion   loops over nodes; emit, machine_code: their machine code

Nothing here knows of planning, and nothing is needed but NumPy.
"""
