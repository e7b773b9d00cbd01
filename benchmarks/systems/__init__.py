"""Users' systems, our planner beside CasADi + IPOPT: `python -m benchmarks.systems --help`.

The systems are written from docs/planner.md alone, as a user would; IPOPT solves the same Euler
transcription from the same guess, so whatever differs is the method's.
"""
