"""Random options of `plan`: those it takes, and those it must refuse by name."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

#: Of the plain call most often, for that is what users make.
TAKEN = (
    {}, {}, {}, {}, {}, {}, {}, {}, {}, {}, {"variance_weight": 0.0}, {"variance_weight": 0.0},
    {"variance_weight": 10.0}, {"method": "newton"}, {"method": "convex"}, {"integrator": "rk4"},
    {"tolerance": 1e-8}, {"tolerance": 1e-2}, {"max_iterations": 1}, {"max_iterations": 7},
    {"starts": 3}, {"terminal_tolerance": 0.1}, {"trust_region": "paper"},
    {"trust_region": "none"}, {"linearization": "literal"}, {"free_first": True},
    {"free_first": False}, {"check_derivatives": True}, {"shooting": True},
    {"free_final_time": True}, {"free_final_time": True, "time_weight": 10.0},
    {"feedback": True}, {"feedback": True, "terminal_weight": 10.0}, {"expected": True},
    {"expected": True, "terminal_weight": 1.0}, {"risk_price": 1.0}, {"risk_price": np.float32(3)},
    {"risk": 0.2, "risk_episodes": 500}, {"risk": 0.05, "feedback": True, "risk_episodes": 500},
    {"solver": "osqp"}, {"feedback": True, "starts": 2},
)  # fmt: skip

NOT_NUMBERS = (None, "much", float("nan"), float("inf"), -1.0, [1.0, 2.0], {}, 1j, object())
NOT_COUNTS = (0, -3, 2.5, "two", True, [1], float("nan"))
NOT_FLAGS = ("yes", 2, [], float("nan"), np.ones(2))
NO_WORDS = ("", "Newton", 3, b"euler", ("euler",))
NOT_CHOICES = (None, *NO_WORDS)
#: Option -> values that are refused, and what is asked for with it.
REFUSED = {
    "variance_weight": NOT_NUMBERS[1:], "tolerance": (0.0, *NOT_NUMBERS),
    "terminal_tolerance": NOT_NUMBERS, "max_iterations": NOT_COUNTS, "starts": NOT_COUNTS,
    "method": NOT_CHOICES, "integrator": NO_WORDS, "linearization": NOT_CHOICES,
    "trust_region": NO_WORDS, "cold_start": NOT_CHOICES,
    "compiled": NOT_FLAGS, "free_first": NOT_FLAGS, "feedback": NOT_FLAGS, "expected": NOT_FLAGS,
    "risk": (0.0, 1.0, *NOT_NUMBERS[1:]), "risk_price": (True, *NOT_NUMBERS[1:]),
    "callback": (3, "print", []), "solver": ("gurobi", 3, None),
    "guess": (3, "x", (1, 2), [[], []]),
    "check_derivatives": NOT_FLAGS, "shooting": NOT_FLAGS, "free_final_time": NOT_FLAGS,
}  # fmt: skip

taken = st.sampled_from(TAKEN)
#: Those that take no seconds.
brief = st.sampled_from(({}, {}, {"variance_weight": 0.0}, {"feedback": True}, {"starts": 2}))
refused = st.sampled_from(sorted(REFUSED)).flatmap(
    lambda name: st.sampled_from(REFUSED[name]).map(lambda value: (name, value))
)
