"""A short campaign in the suite, the same inputs each time; and that the judge can say no.

`make fuzz` tries thousands, of more structures.
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from slipcar.planner import plan

from . import judge, options
from .calls import call
from .ideas import IDEAS, Scope
from .problems import Kind, Own, Recipe

#: Inputs of each idea, and how wide they are drawn.
COUNTS = {
    "problems": 60, "worlds": 8, "scenarios": 60, "options": 60, "files": 60, "batches": 5,
    "receding": 4,
}  # fmt: skip
SHORT = Scope(kinds=6, most_intervals=20, asked=options.brief)


@pytest.mark.parametrize("name", IDEAS)
def test_nothing_is_wrong_with(name):
    assert set(COUNTS) == set(IDEAS)

    @settings(
        max_examples=COUNTS[name], derandomize=True, database=None, deadline=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(IDEAS[name].inputs(SHORT))
    def each(case):
        assert IDEAS[name].check(case) == []

    each()


#: Inputs that once were findings.
FOUND = [
    # A raw LinAlgError: what a ball holds had a curvature of one beside an R of 1e-20.
    ("problems", (Recipe(Kind("jump", 3, 2, "some", "certain", ("walls", "start_covariance")),
                         7568, 80, "wild", "ball and box", (0, 6, 1, -3)),
                  {"variance_weight": 0.0})),
    # A plan with feedback whose gains are not finite was followed, to actions that are not.
    ("receding", (Recipe(Kind("domain", 2, 2, "curved", "certain"), 18834380, 3, "even", "loose"),
                  {"iterations": 3})),
    # NumPy warned out of the replans of a drift that overflows.
    ("receding", (Recipe(Kind("huge", 1, 1, "free"), 1184, 2, "even", "box", (-6, 1, -3, 0)),
                  {"saturation": 0.0})),
    # An integer beyond float64 was a raw OverflowError.
    ("scenarios", {"clearance": 10**400}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "case"), FOUND, ids=[name for name, _ in FOUND])
def test_what_was_found_stays_mended(name, case):
    assert IDEAS[name].check(case) == []


# --- the judge -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def planned():
    problem = Own(Recipe(bounds="box"))
    return problem, plan(problem, variance_weight=0.0, tolerance=1e-8)


def test_the_judge_finds_nothing_where_there_is_nothing(planned):
    assert judge.findings(*planned) == []


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        (lambda p: {"controls": 1.02 * p.controls, "effort": 1.0404 * p.effort}, "steps"),
        (lambda p: {"controls": p.controls + 9.0}, "outside"),
        (lambda p: {"effort": 1.001 * p.effort}, "add up"),
        (lambda p: {"running_cost": 1.0}, "add up"),
        (lambda p: {"mean": p.mean + 0.1}, "start"),
        (lambda p: {"mean": p.mean * np.nan}, "not finite"),
        (lambda p: {"covariance": p.covariance - np.eye(2)}, "eigenvalue"),
    ],
)
def test_the_judge_finds_what_was_spoiled(planned, changes, word):
    problem, p = planned
    assert any(word in finding for finding in judge.findings(problem, p.replace(**changes(p))))


def test_the_judge_tells_an_extremal_from_any_other_way_there(planned):
    """The known path obeys everything but the maximum principle."""
    problem, p = planned
    u, t = problem.known, p.times
    x = judge.rolled(problem, "euler", t, u)
    effort = float(np.einsum("k,ki,ij,kj", np.diff(t), u, problem.control_weight, u))
    other = p.replace(mean=x, controls=u, effort=effort)
    assert any("no extremal" in finding for finding in judge.findings(problem, other))


def test_the_judge_finds_a_missed_end(planned):
    problem, p = Own(Recipe(bounds="box")), planned[1]
    asked = problem.terminal
    problem.terminal = lambda x: asked(x) + 0.01
    assert any("g[0]" in finding for finding in judge.findings(problem, p))


@pytest.mark.parametrize(
    ("function", "word"),
    [
        (lambda: 1 / 0, "ZeroDivisionError"),
        (lambda: int("x"), "names no cause"),
        (lambda: np.log(np.zeros(1)), "RuntimeWarning"),
        (lambda: np.linalg.inv(np.zeros((2, 2))), "LinAlgError"),
    ],
)
def test_a_call_is_judged_by_how_it_ends(function, word):
    (finding,) = call(function).findings
    assert word in finding


def test_a_refusal_that_names_its_cause_is_none():
    def refuse():
        raise ValueError("tolerance must be > 0, not -1")

    assert call(refuse).findings == ()
    assert isinstance(call(refuse).error, ValueError)
