"""What `plan` refuses of risk, feedback and expected costs, and how it says so."""

import types

import numpy as np
import pytest

from slipcar.planner import Feedback, OpenLoop, Status, plan


def cart(**more):
    """A cart on a line, without anything to keep clear of."""
    return types.SimpleNamespace(
        start=np.zeros(2),
        times=np.linspace(0.0, 1.0, 9),
        control_weight=np.eye(1),
        drift=lambda t, x, u: np.concatenate([x[..., 1:], u], axis=-1),
        diffusion=lambda t, x: np.broadcast_to(np.array([[0.1], [0.0]]), (*x.shape, 1)),
        terminal=lambda x: x - np.array([1.0, 0.0]),
        **more,
    )


@pytest.mark.parametrize(
    "risk",
    [0, 1, 0.0, 1.0, -0.1, 1.5, np.nan, np.inf, True, False, "0.01", [0.01], np.array([0.01]), 1j],
)
def test_a_risk_is_a_probability(paper, risk):
    with pytest.raises(ValueError, match=r"risk must be a probability in \(0, 1\)"):
        plan(paper, risk=risk)


@pytest.mark.parametrize("price", [-1, -1e-9, np.nan, np.inf, "1", [1.0], {}, True, False])
def test_a_price_is_a_number_not_below_zero(paper, price):
    with pytest.raises(ValueError, match="risk_price"):
        plan(paper, risk_price=price)


def test_a_risk_and_its_price_exclude_each_other(paper):
    with pytest.raises(ValueError, match="exclude each other"):
        plan(paper, risk=0.01, risk_price=1.0)


@pytest.mark.parametrize("episodes", [0, 99, -5, 1000.5, "many", True, None])
def test_paths_of_a_verification_are_counted(paper, episodes):
    with pytest.raises(ValueError, match="risk_episodes must be an integer >= 100"):
        plan(paper, risk=0.01, risk_episodes=episodes)


@pytest.mark.parametrize("name", ["feedback", "expected"])
@pytest.mark.parametrize("value", ["yes", None, 2, 0.5])
def test_switches_are_true_or_false(paper, name, value):
    with pytest.raises(ValueError, match=f"{name} must be True or False"):
        plan(paper, **{name: value})


@pytest.mark.parametrize("options", [{"risk": 0.1}, {"risk_price": 1.0}])
def test_there_is_no_risk_without_a_constraint(options):
    with pytest.raises(ValueError, match=r"constraint\(t, x\)"):
        plan(cart(), **options)


@pytest.mark.parametrize(
    "weight",
    [-1, [1.0, 2.0], np.ones((5, 1)), np.nan, [1, 1, 1, 1, -1], [1, 1, 1, 1, np.inf], np.ones(6)],
)
def test_a_terminal_weight_fits_the_terminal_condition(paper, weight):
    with pytest.raises(ValueError, match=r"terminal_weight must be a number or \(5,\) numbers"):
        plan(paper, feedback=True, terminal_weight=weight)


@pytest.mark.parametrize("weight", ["heavy", {"a": 1}])
def test_a_terminal_weight_is_made_of_numbers(paper, weight):
    with pytest.raises(ValueError, match="terminal_weight must be numbers"):
        plan(paper, feedback=True, terminal_weight=weight)


def test_a_terminal_weight_needs_an_expected_cost(paper):
    with pytest.raises(ValueError, match="terminal_weight is of expected costs"):
        plan(paper, terminal_weight=1.0)


WANTED = [{"feedback": True}, {"expected": True}, {"risk": 0.1}, {"risk_price": 1.0}]


@pytest.mark.parametrize("wanted", WANTED, ids=lambda w: next(iter(w)))
@pytest.mark.parametrize(
    "other",
    [
        {"method": "convex"},
        {"solver": "osqp"},
        {"solver": "cvxpy"},
        {"shooting": True},
        {"free_final_time": True},
        {"terminal_tolerance": 1e-3},
        {"trust_region": "adaptive"},
        {"linearization": "literal"},
    ],
    ids=lambda o: next(iter(o)),
)
def test_what_cannot_be_combined_is_refused_by_name(paper, wanted, other):
    with pytest.raises(ValueError, match="cannot be combined with") as caught:
        plan(paper, **wanted, **other)
    name = next(iter(other))
    assert name in str(caught.value)


def test_a_ball_of_controls_is_refused():
    problem = cart(control_radius=8.0, constraint=lambda t, x: x[..., :1] - 2.0)
    assert plan(problem, variance_weight=0.0).status.ok
    for wanted in WANTED:
        with pytest.raises(ValueError, match="control_radius"):
            plan(problem, **wanted)


def test_several_starts_and_a_guess_exclude_each_other(paper):
    known = plan(paper, expected=True)
    with pytest.raises(ValueError, match="starts > 1 and guess"):
        plan(paper, feedback=True, starts=3, guess=known)


# ------------------------------------------------------------------------------ constraints


@pytest.mark.parametrize("wanted", WANTED, ids=lambda w: next(iter(w)))
@pytest.mark.parametrize(
    ("constraint", "message"),
    [
        (lambda t, x: x[..., 0] - 2.0, r"shape \(2, any\), not \(2,\)"),
        (lambda t, x: np.zeros((3, 1)), r"shape \(2, any\), not \(3, 1\)"),
        (lambda t, x: np.log(x[..., :1] - 5.0), "must be finite"),
        (lambda t, x: "far", "must be numbers"),
        (lambda t, x: None, "shape"),
    ],
    ids=["flat", "other points", "infinite", "text", "nothing"],
)
def test_what_a_constraint_returns_is_looked_at(constraint, message, wanted):
    problem = cart(constraint=constraint)
    with (
        pytest.raises(ValueError, match=r"constraint\(t, x\).*" + message),
        np.errstate(all="ignore"),
    ):
        plan(problem, **wanted)


# ------------------------------------------------------------------------------ typed ends


def test_too_few_steps_do_not_pass_for_an_answer(paper):
    p = plan(paper, feedback=True, max_iterations=1)
    assert p.status is Status.MAX_ITERATIONS
    assert p.message
    p = plan(paper, risk=0.01, max_iterations=1, risk_episodes=100)
    assert not p.status.ok
    assert p.message


def test_a_callback_that_stops_leaves_no_expected_cost(paper):
    p = plan(paper, feedback=True, callback=lambda iteration: True)
    assert p.status is Status.STOPPED
    assert p.expected is None
    assert p.risk is None


@pytest.mark.parametrize("nodes", [2, 3])
def test_a_horizon_too_short_for_the_end_is_no_answer(paper, nodes):
    """Five conditions, two controls a node."""
    for wanted in ({"expected": True}, {"risk": 0.05, "risk_episodes": 100}):
        p = plan(paper.replace(nodes=nodes), starts=1, max_iterations=20, **wanted)
        assert not p.status.ok
        assert np.isfinite(p.controls).all()
    # Where the end is only charged there is an answer: get as near as is worth it.
    p = plan(paper.replace(nodes=nodes), starts=1, feedback=True)
    assert p.status.ok
    assert p.expected.goal > 100.0


# ------------------------------------------------------------------------------ controllers


@pytest.fixture(scope="module")
def law(paper):
    return plan(paper, feedback=True)


@pytest.mark.parametrize(
    "change",
    [
        lambda g: g[:-1],
        lambda g: g[..., :4],
        lambda g: g.swapaxes(1, 2),
        lambda g: g[0],
        lambda g: np.where(np.arange(5) == 2, np.nan, g),
    ],
)
def test_gains_of_another_shape_are_refused(law, change):
    with pytest.raises(ValueError, match="gains must be finite and of shape"):
        Feedback(law.replace(gains=change(law.gains)))


@pytest.mark.parametrize("controller", [OpenLoop, Feedback])
def test_an_observation_without_state_is_refused(controller):
    p = plan(cart(), feedback=True, terminal_weight=10.0)
    assert p.gains.shape == (8, 1, 2)
    play = controller(p)
    with pytest.raises(ValueError, match="must hold the 2 states and the time"):
        play.predict(np.zeros(2))
    with pytest.raises(ValueError, match="must be finite"):
        play.predict(np.array([0.0, np.nan, 0.0]))
    action, _ = play.predict(np.array([*p.mean[3], p.times[3]]))
    np.testing.assert_allclose(action, p.controls[3], rtol=1e-5)


@pytest.mark.parametrize("controller", [OpenLoop, Feedback])
def test_an_observation_of_the_car_has_its_length(law, controller):
    play = controller(law)
    for length in (0, 1, 3, 1001):
        with pytest.raises(ValueError, match="observation"):
            play.predict(np.zeros(length))
