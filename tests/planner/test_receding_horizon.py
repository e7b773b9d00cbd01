"""The receding-horizon controller: its replans, its memory, and what happens when one fails."""

import dataclasses
import pickle

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.envs.observation import observe
from slipcar.evaluation import evaluate
from slipcar.planner import OpenLoop, Status, plan
from slipcar.planner.receding_horizon import RecedingHorizon

PLAN = ("x", "u", "gains", "eta", "adjoint")


class Cart:
    """A double integrator with noise on its speed, from (1, 0) to rest at the origin."""

    def __init__(self, intervals=20, **members):
        self.start = np.array([1.0, 0.0])
        self.times = np.linspace(0.0, 2.0, intervals + 1)
        self.control_weight = np.eye(1)
        self.__dict__.update(members)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.broadcast_to([[0.0], [0.1]], (*x.shape[:-1], 2, 1))

    def terminal(self, x):
        return x


class Walled(Cart):
    """Its drag is no number beyond speed 1."""

    def drift(self, t, x, u):
        drag = 0.1 * np.sqrt(1.0 - x[..., 1])
        return np.stack([x[..., 1], u[..., 0] - drag], axis=-1)


def lq_transition(cart):
    dt = cart.times[1] - cart.times[0]
    return dt, np.array([[1.0, dt], [0.0, 1.0]]), np.array([[0.0], [dt]])


def observed(cart, k, x):
    x = np.asarray(x, dtype=float)
    return np.concatenate([x, np.full((*x.shape[:-1], 1), cart.times[k])], axis=-1)


@pytest.fixture(scope="module")
def controller(paper):
    return RecedingHorizon(paper)


def around(controller, count, spread=0.05, seed=0):
    """Observations about the first plan, at random nodes."""
    p, rng = controller.plan, np.random.default_rng(seed)
    k = rng.integers(0, len(p.controls), size=count)
    x = p.mean[k] + spread * rng.normal(size=(count, p.mean.shape[1]))
    return observe(p.problem, "state", p.times[k], x)


# ------------------------------------------------------------------ what a replan is


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("k", [0, 7, 18, 19])
def test_linear_quadratic_replans_are_the_riccati_law(k, compiled):
    """Additive noise, quadratic costs: certainty equivalence holds and the law is LQR's."""
    W = np.array([50.0, 20.0])
    cart = Cart(terminal_weight=W)
    dt, A, B = lq_transition(cart)
    P = np.diag(W)
    for _ in range(19 - k):
        gain = np.linalg.solve(dt * np.eye(1) + B.T @ P @ B, B.T @ P @ A)
        P = A.T @ P @ (A - B @ gain)
    gain = np.linalg.solve(dt * np.eye(1) + B.T @ P @ B, B.T @ P @ A)
    x = np.array([[0.7, -0.4], [1.3, 0.2], [-2.0, 1.0]])
    c = RecedingHorizon(cart, compiled=compiled)
    u, _ = c.predict(observed(cart, k, x))
    np.testing.assert_allclose(u, -x @ gain.T, rtol=1e-5, atol=1e-6)
    assert (c.replans, c.failures) == (3, 0)


def test_exact_terminal_condition_is_met_at_least_effort_from_wherever_it_is():
    cart = Cart()
    x = np.array([1.2, 0.3])
    u, _ = RecedingHorizon(cart).predict(observed(cart, 5, x))
    _, A, B = lq_transition(cart)
    K = 15
    effect = np.hstack([np.linalg.matrix_power(A, K - 1 - k) @ B for k in range(K)])
    least = np.linalg.lstsq(effect, -np.linalg.matrix_power(A, K) @ x, rcond=None)[0]
    np.testing.assert_allclose(u, least[:1], rtol=1e-5)


def test_at_the_planned_start_the_first_control_is_the_plans(controller, paper):
    before = controller.replans
    action, _ = controller.predict(observe(paper, "state", 0.0, paper.start))
    np.testing.assert_allclose(action * paper.control_bounds, controller.plan.controls[0], 1e-6)
    assert controller.replans == before  # there is nothing to add
    assert controller.status is Status.CONVERGED


def test_without_noise_every_replan_is_the_rest_of_the_plan(paper):
    """Bellman's principle of optimality."""
    s = paper.replace(slip=(0.0, 0.0))
    c = RecedingHorizon(s, iterations=20, tolerance=1e-12)
    x, state = s.start, None
    for k in range(s.nodes - 1):
        _, state = c.predict(np.append(x, s.times[k]), state)
        np.testing.assert_array_equal(state.interval, [k])
        np.testing.assert_allclose(state.plans["u"][0, k:], c.plan.controls[k:], atol=2e-5)
        np.testing.assert_allclose(state.plans["x"][0, k:], c.plan.mean[k:], atol=2e-5)
        x = x + s.dt * s.drift(s.times[k], x, state.plans["u"][0, k])
    assert c.failures == 0
    assert s.goal_cost(x) < 1.0


@pytest.mark.parametrize("price", [0.0, 30.0])
def test_numpy_and_compiled_make_the_same_plans(paper, price):
    pytest.importorskip("llvmlite")
    one, other = (RecedingHorizon(paper, risk_price=price, compiled=c) for c in (True, False))
    obs = around(one, 4, seed=5)
    states = [c.predict(obs)[1] for c in (one, other)]
    for name in PLAN:
        ours, theirs = (state.plans[name] for state in states)
        np.testing.assert_allclose(ours, theirs, atol=1e-8 * (1.0 + np.abs(theirs).max()))


def test_replanning_beats_the_open_loop_on_the_same_paths(controller, paper):
    ours = evaluate(controller, paper, 256, seed=3)
    open_loop = evaluate(OpenLoop(plan(paper)), paper, 256, seed=3)
    saved = open_loop.metrics.total - ours.metrics.total
    assert saved.mean() > 4.0 * saved.std() / 16.0
    assert ours.metrics.total.mean() < 5.3
    assert ours.failures == 0


def test_a_price_of_risk_keeps_margins(paper):
    clearance = []
    for price in (0.0, 100.0):
        m = evaluate(RecedingHorizon(paper, risk_price=price), paper, 128, seed=4).metrics
        clearance.append(np.quantile(m.clearance, 0.05))
    assert clearance[1] > clearance[0] + 0.01


@pytest.mark.parametrize("seed", [0, 3, 6])
def test_random_worlds(seed):
    world = Scenario.random(seed)
    c = RecedingHorizon(world)
    ours = evaluate(c, world, 64, seed=1)
    assert (c.status, ours.failures) == (Status.CONVERGED, 0)
    open_loop = evaluate(OpenLoop(plan(world)), world, 64, seed=1)
    assert ours.metrics.total.mean() < open_loop.metrics.total.mean()


# ------------------------------------------------------------------ batches and memory


@pytest.mark.parametrize("workers", [1, 3])
def test_batches_give_the_bits_of_single_episodes(paper, controller, workers):
    c = RecedingHorizon(paper, workers=workers)
    obs = around(controller, 50)
    together, _ = c.predict(obs)
    for i in range(0, 50, 7):
        np.testing.assert_array_equal(controller.predict(obs[i])[0], together[i])
    np.testing.assert_array_equal(c.predict(obs.reshape(5, 10, 6))[0].reshape(50, 2), together)
    assert c.predict(obs[:0])[0].shape == (0, 2)


def drive(controller, s, noise, parts):
    """Actions of episodes driven in separate batches, `parts` of rows, 12 steps."""
    found = np.empty((12, len(noise), 2), dtype=np.float32)
    for rows in parts:
        x, state = np.repeat(s.start[None], len(rows), axis=0), None
        for k in range(12):
            start = np.full(len(rows), k == 0)
            obs = observe(s, "state", s.times[k], x)
            action, state = controller.predict(obs, state, start)
            found[k, rows] = action
            u = action * s.control_bounds
            x = x + s.dt * s.drift(s.times[k], x, u) + noise[rows, k]
    return found


def test_episodes_do_not_see_each_other(controller, paper):
    noise = 0.02 * np.random.default_rng(1).normal(size=(7, 12, 5))
    together = drive(controller, paper, noise, [np.arange(7)])
    apart = drive(
        controller, paper, noise, [np.array([4]), np.array([0, 6, 2]), np.array([1, 3, 5])]
    )
    np.testing.assert_array_equal(together, apart)


def test_state_is_not_written_to_and_starts_reset_single_episodes(controller, paper):
    p = controller.plan
    x = p.mean[3] + 0.03 * np.random.default_rng(2).normal(size=(3, 5))
    first, second = (observe(paper, "state", p.times[k], x) for k in (3, 4))
    _, state = controller.predict(first)
    on, _ = controller.predict(second, state)
    np.testing.assert_array_equal(controller.predict(second, state)[0], on)
    fresh, _ = controller.predict(second)
    mixed, after = controller.predict(second, state, np.array([False, True, False]))
    np.testing.assert_array_equal(mixed, np.stack([on[0], fresh[1], on[2]]))
    np.testing.assert_array_equal(after.interval, [4, 4, 4])
    # A new episode is known by its time as well; and times may differ within a batch.
    begun = observe(paper, "state", 0.0, paper.start)
    back, later = controller.predict(np.stack([begun, second[1], second[2]]), state)
    np.testing.assert_array_equal(back, np.stack([controller.predict(begun)[0], on[1], on[2]]))
    np.testing.assert_array_equal(later.interval, [0, 4, 4])


def test_headings_are_known_modulo_a_turn(controller, paper):
    x = controller.plan.mean[10] + 0.02
    turned = x + np.array([0.0, 0.0, 4.0 * np.pi, 0.0, 0.0])
    a, b = (controller.predict(np.append(y, paper.times[10]))[0] for y in (x, turned))
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_it_travels_to_other_processes(controller):
    copy = pickle.loads(pickle.dumps(controller))
    obs = around(controller, 3)
    np.testing.assert_array_equal(copy.predict(obs)[0], controller.predict(obs)[0])
    assert copy.fingerprint() == controller.fingerprint()


def test_fingerprint_tells_options_apart(controller, paper):
    others = [RecedingHorizon(paper, risk_price=1.0), RecedingHorizon(paper, iterations=2)]
    assert len({c.fingerprint() for c in (controller, *others)}) == 3
    assert RecedingHorizon(paper).fingerprint() == controller.fingerprint()


# ------------------------------------------------------------------ failures and the end


@pytest.mark.parametrize("compiled", [None, False])
def test_failed_replans_leave_the_last_plan_with_its_feedback(compiled):
    cart = Walled(terminal_weight=np.array([50.0, 20.0]))
    c = RecedingHorizon(cart, compiled=compiled)
    inside, outside = np.array([0.9, -0.2]), np.array([0.8, 1.5])  # where the drift is NaN
    _, state = c.predict(observed(cart, 3, [inside, inside]))
    plans = state.plans
    u, state = c.predict(observed(cart, 4, [inside, outside]), state)
    law = plans["u"][1, 4] + plans["gains"][1, 4] @ (outside - plans["x"][1, 4])
    np.testing.assert_allclose(u[1], law, rtol=1e-6)
    np.testing.assert_array_equal(state.failures, [0, 1])
    u, state = c.predict(observed(cart, 5, [inside, outside]), state)
    law = plans["u"][1, 5] + plans["gains"][1, 5] @ (outside - plans["x"][1, 5])
    np.testing.assert_allclose(u[1], law, rtol=1e-6)
    np.testing.assert_array_equal(state.failures, [0, 2])
    _, state = c.predict(observed(cart, 6, [inside, inside]), state)  # it recovers
    np.testing.assert_array_equal(state.failures, [0, 2])
    assert (c.replans, c.failures) == (8, 2)
    assert 0.0 < c.time_per_replan == c.seconds / 8
    _, state = c.predict(observed(cart, 7, [inside, inside]), state, np.array([True, True]))
    np.testing.assert_array_equal(state.failures, [0, 0])


def test_near_an_exact_end_the_last_feedback_law_takes_over():
    cart = Cart()
    c = RecedingHorizon(cart)  # q = 2, m = 1: six intervals
    x = c.plan.mean + np.array([0.02, -0.01])
    _, state = c.predict(observed(cart, 14, x[14]))
    assert c.replans == 1
    gains = state.plans["gains"][0]
    for k in (15, 19):
        u, _ = c.predict(observed(cart, k, x[k]), state)
        law = state.plans["u"][0, k] + gains[k] @ (x[k] - state.plans["x"][0, k])
        np.testing.assert_allclose(u, law, rtol=1e-5)
        assert np.abs(gains[k]).max() > 0.1
    assert (c.replans, c.failures) == (1, 0)
    early = RecedingHorizon(cart, handover=20)
    early.predict(observed(cart, 1, x[1]))
    assert early.replans == 0


@dataclasses.dataclass(frozen=True)
class Memory:
    """How often a driver that fails at every other step was asked."""

    steps: np.ndarray

    @property
    def failures(self):
        return self.steps // 2


class Forgetful:
    """A recurrent controller that stands still."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        steps = np.zeros(len(observation), dtype=int) if state is None else state.steps
        assert (np.asarray(episode_start) == (state is None)).all()
        return np.zeros((len(observation), 2)), Memory(steps + 1)


@pytest.mark.parametrize("batch_size", [None, 1024])
def test_rollouts_hand_states_on_and_count_failures_of_the_episodes_asked_for(paper, batch_size):
    done = evaluate(Forgetful(), paper, 1500, batch_size=batch_size)
    assert done.failures == 1500 * 20
    assert evaluate(OpenLoop(plan(paper)), paper, 10).failures == 0


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"risk_price": -1.0}, "risk_price must be finite and >= 0"),
        ({"risk_price": np.nan}, "risk_price"),
        ({"iterations": 0}, "iterations must be an integer >= 1"),
        ({"iterations": 2.0}, "iterations"),
        ({"tolerance": 0.0}, "tolerance must be finite and > 0"),
        ({"saturation": "two"}, "saturation"),
        ({"workers": -1}, "workers must be an integer >= 0"),
        ({"compiled": "yes"}, "compiled must be None, True or False"),
        ({"handover": -1}, r"handover must be None or an integer in \[0, 40\]"),
        ({"handover": 41}, "handover"),
        ({"handover": True}, "handover"),
    ],
)
def test_options_out_of_range(paper, options, message):
    with pytest.raises(ValueError, match=message):
        RecedingHorizon(paper, **options)


@pytest.mark.parametrize(
    ("problem", "options", "message"),
    [
        (Cart(1), {}, "N - 1 = 1 intervals is too short for q = 2 .* m = 1"),
        (Cart(), {"handover": 1}, r"handover must be None or an integer in \[2, 20\]"),
        (Cart(control_radius=1.0), {}, "control_radius"),
        (Cart(), {"risk_price": 1.0}, "constraint"),
        (Cart(terminal_weight=np.ones(3)), {}, "terminal_weight"),
        (Cart(terminal_weight=-np.ones(2)), {}, "terminal_weight"),
    ],
)
def test_problems_it_does_not_know(problem, options, message):
    with pytest.raises(ValueError, match=message):
        RecedingHorizon(problem, **options)


def test_observations_without_a_state(controller, paper):
    for bad in (np.zeros(5), np.zeros((3, 7)), np.float64(0.0)):
        with pytest.raises(ValueError, match="observation"):
            controller.predict(bad)
    with pytest.raises(ValueError, match="finite"):
        controller.predict(np.full(6, np.nan))
    with pytest.raises(ValueError, match="2 states"):
        RecedingHorizon(Cart()).predict(np.zeros(2))


def test_states_of_something_else(controller):
    obs = around(controller, 3)
    _, state = controller.predict(obs)
    for bad in (state, "memory", (None,)):
        with pytest.raises(ValueError, match="state must be what predict returned"):
            controller.predict(obs[:2], bad)
    with pytest.raises(ValueError, match="episode_start"):
        controller.predict(obs, state, np.zeros(2, dtype=bool))


def test_the_obstacle_cost_of_its_plan_is_that_of_the_mean(controller):
    problem, mean = controller.plan.problem, controller.plan.mean
    dt = problem.dt
    assert controller.plan.obstacle_cost == pytest.approx(
        dt * np.sum(problem.obstacle_power(mean[1:])), rel=1e-9
    )
