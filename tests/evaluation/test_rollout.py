import re

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate, sample_paths
from slipcar.evaluation.metrics import FIELDS
from slipcar.evaluation.noise import BLOCK, block_generator, block_noise


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


# ------------------------------------------------------------------ closed forms


def test_a_standing_car_does_not_move(paper, replay):
    metrics = evaluate(replay(paper, (0.0, 0.0)), paper, 10).metrics
    np.testing.assert_array_equal(metrics.total, paper.goal_cost(paper.start))
    np.testing.assert_array_equal(metrics.effort, 0.0)
    np.testing.assert_allclose(metrics.clearance, paper.signed_distance(paper.start))
    assert not metrics.collision.any()


def test_a_straight_drive_has_no_noise(replay):
    open_field = Scenario(start=(0, 0, 0.3, 0.8, 0), goal=(3, 1, 0.3, 0.8, 0), horizon=4.0)
    states, _ = sample_paths(replay(open_field, (0.0, 0.0)), open_field, 50)
    way = 0.8 * open_field.times
    expected = np.stack([way * np.cos(0.3), way * np.sin(0.3)], axis=-1)
    np.testing.assert_allclose(states[..., :2], np.broadcast_to(expected, (50, 41, 2)), atol=1e-12)
    metrics = evaluate(replay(open_field, (0.0, 0.0)), open_field, 50).metrics
    assert np.ptp(metrics.total) == 0.0
    assert np.isinf(metrics.clearance).all()


def test_heading_variance_of_a_circle_is_that_of_brownian_motion(replay):
    # ω and v constant: θ(T) − θ(0) − ωT = β² ω v B(T), whatever the step.
    v, omega, T, beta2 = 1.5, 0.8, 3.0, 0.2
    circle = Scenario(
        start=(0, 0, 0, v, omega), goal=(0, 0, omega * T, v, omega), horizon=T, slip=(0.1, beta2)
    )
    errors = evaluate(replay(circle, (0.0, 0.0)), circle, 40_000, seed=3).metrics.heading_error
    expected = T * (beta2 * omega * v) ** 2
    # The variance of a sample of n squares has relative error √(2/n) = 0.7 %.
    assert np.mean(errors**2) == pytest.approx(expected, rel=0.03)


def test_agrees_with_one_path_written_out(paper, replay, turning):
    """Physics and cost of docs/method.md, one episode at a time, without slipcar.envs."""
    episode, seed = BLOCK + 7, 11
    noise = np.stack([step[7, 0] for step in block_noise(seed, 1, paper)])
    dt, (alpha2, beta2) = 0.125, (0.1, 0.01)
    x, effort, obstacle, clearance = np.zeros(5), 0.0, 0.0, np.inf
    for u, xi in zip(turning.astype(np.float32).astype(float), noise, strict=True):
        vw = x[3] * x[4]
        drift = np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), x[4], *u])
        slip = np.array([alpha2 * vw * xi[0], alpha2 * vw * xi[1], beta2 * vw * xi[2], 0, 0])
        x = x + dt * drift + np.sqrt(dt) * slip
        effort += dt * (u @ u)
        for cx, cy, radius in paper.obstacles:
            distance = np.hypot(x[0] - cx, x[1] - cy)
            obstacle += dt * 500.0 * max(0.0, (radius + 0.13) ** 2 - distance**2) ** 2
            clearance = min(clearance, distance - radius)
    error = x - np.array([2.2, 3.0, 0, 0, 0])
    metrics = evaluate(replay(paper, turning), paper, episode + 1, seed).metrics
    # Actions travel as float32.
    assert metrics.effort[episode] == pytest.approx(effort, rel=1e-6)
    assert metrics.obstacle[episode] == pytest.approx(obstacle, rel=1e-5, abs=1e-9)
    assert metrics.goal[episode] == pytest.approx(100.0 * error @ error, rel=1e-6)
    assert metrics.clearance[episode] == pytest.approx(clearance, abs=1e-6)
    assert metrics.collision[episode] == (clearance < 0.0)
    assert metrics.position_error[episode] == pytest.approx(np.hypot(*error[:2]), rel=1e-6)
    assert metrics.heading_error[episode] == pytest.approx(abs(error[2]), rel=1e-5)
    assert metrics.speed_error[episode] == pytest.approx(abs(error[3]), abs=1e-6)


def test_without_slip_all_paths_are_one(paper, replay, turning):
    dry = paper.replace(slip=(0.0, 0.0))
    metrics = evaluate(replay(dry, turning), dry, 300).metrics
    assert np.ptp(metrics.total) == 0.0


# ------------------------------------------------------------------ the paths


def test_two_controllers_see_the_same_noise(paper, replay, turning):
    def noise_felt(controller):
        x, u = sample_paths(controller, paper, 30, seed=5)
        x, after = x[:, :-1], x[:, 1:]
        drift = paper.drift(None, x, u)
        scale = np.sqrt(paper.dt) * x[..., 3] * x[..., 4]
        slipped = np.abs(scale) > 1e-3
        felt = (after - x - paper.dt * drift)[..., :3] / np.array([0.1, 0.1, 0.01])
        return felt / np.where(slipped, scale, np.nan)[..., None]

    one, two = noise_felt(replay(paper, turning)), noise_felt(replay(paper, 0.6 * turning))
    both = np.isfinite(one) & np.isfinite(two)
    assert both.sum() > 500
    np.testing.assert_allclose(one[both], two[both], atol=1e-9)


def test_noise_is_standard_normal_and_differs_between_blocks_and_seeds(paper):
    drawn = np.concatenate(list(block_noise(0, 0, paper)))
    assert abs(drawn.mean()) < 4.0 / np.sqrt(drawn.size)
    assert abs(drawn.var() - 1.0) < 4.0 * np.sqrt(2.0 / drawn.size)
    others = [block_generator(*key).standard_normal(BLOCK) for key in ((0, 0), (0, 1), (1, 0))]
    correlation = np.corrcoef(others)[np.triu_indices(3, 1)]
    assert (np.abs(correlation) < 4.5 / np.sqrt(BLOCK)).all()


@pytest.mark.parametrize("batch_size", [1, 1000, BLOCK, 2500, 100_000])
def test_results_do_not_depend_on_the_batch_size(paper, layers, batch_size):
    whole = evaluate(layers(), paper, 2500, seed=1).metrics
    assert same(whole, evaluate(layers(), paper, 2500, seed=1, batch_size=batch_size).metrics)


def test_results_do_not_depend_on_the_workers(paper, layers):
    alone = evaluate(layers(), paper, 2500, seed=1).metrics
    assert same(alone, evaluate(layers(), paper, 2500, seed=1, n_jobs=2).metrics)


def test_an_episode_depends_on_seed_and_index_alone(paper, layers):
    many = evaluate(layers(), paper, 2000, seed=1).metrics
    assert same(evaluate(layers(), paper, 1, seed=1).metrics, many.first(1))
    assert same(evaluate(layers(), paper, 1100, seed=1).metrics, many.first(1100))
    assert not same(evaluate(layers(), paper, 1100, seed=2).metrics, many.first(1100))


def test_recorded_paths_are_those_measured(paper, layers):
    states, controls = sample_paths(layers(), paper, 1100, seed=4)
    metrics = evaluate(layers(), paper, 1100, seed=4).metrics
    np.testing.assert_array_equal(paper.goal_cost(states[:, -1]), metrics.goal)
    distance = paper.signed_distance(states[:, 1:]).min(axis=1)
    np.testing.assert_array_equal(distance, metrics.clearance)
    effort = paper.dt * paper.control_power(controls).sum(axis=1)
    np.testing.assert_allclose(effort, metrics.effort, rtol=1e-12)


def test_substeps_refine_the_same_problem(paper, replay, turning):
    coarse = evaluate(replay(paper, turning), paper, 20_000, substeps=1).metrics
    fine = evaluate(replay(paper, turning), paper, 20_000, substeps=4).metrics
    np.testing.assert_array_equal(coarse.effort, fine.effort)
    # Order 1 in the step: a fourth of the step moves the mean by a few centimetres at most.
    assert coarse.position_error.mean() == pytest.approx(fine.position_error.mean(), abs=0.1)
    assert not np.array_equal(coarse.total, fine.total)


# ------------------------------------------------------------------ what predict is given


class Recorder:
    """Remembers what it was given; counts the steps in its hidden state."""

    def __init__(self, **attributes):
        self.calls = []
        self.__dict__.update(attributes)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls.append((observation.copy(), state, episode_start.copy(), deterministic))
        return np.zeros((len(observation), 2)), 0 if state is None else state + 1


def test_hidden_state_and_episode_start_are_passed_on(paper):
    recorder = Recorder()
    evaluate(recorder, paper, 10)
    assert [state for _, state, _, _ in recorder.calls] == [None, *range(39)]
    assert [start.all() for _, _, start, _ in recorder.calls] == [True] + 39 * [False]
    assert all(deterministic for *_, deterministic in recorder.calls)


@pytest.mark.parametrize(("attributes", "entries"), [({}, 12), ({"observation": "state"}, 6)])
def test_the_controller_chooses_its_observation(paper, attributes, entries):
    recorder = Recorder(**attributes)
    evaluate(recorder, paper, 10)
    assert {call[0].shape for call in recorder.calls} == {(BLOCK, entries)}


def test_a_stable_baselines_model_is_given_what_it_was_trained_on(paper):
    from gymnasium.spaces import Box

    recorder = Recorder(observation_space=Box(-1, 1, (6,)))
    evaluate(recorder, paper, 1)
    assert recorder.calls[0][0].shape == (BLOCK, 6)
    with pytest.raises(ValueError, match=r"shape \(7,\).*12 \(features\)"):
        evaluate(Recorder(observation_space=Box(-1, 1, (7,))), paper, 1)


def test_a_slow_controller_is_shown_only_the_rows_it_wants(paper, replay, turning):
    recorder = Recorder(rows=2)
    evaluate(recorder, paper, 3)
    assert {call[0].shape for call in recorder.calls} == {(2, 12)}
    assert len(recorder.calls) == 2 * 40
    alone, all_at_once = replay(paper, turning), replay(paper, turning)
    alone.rows = 1
    assert same(evaluate(alone, paper, 5).metrics, evaluate(all_at_once, paper, 5).metrics)


# ------------------------------------------------------------------ bad input


class Answer:
    def __init__(self, answer):
        self.answer = answer

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return self.answer(observation)


def nan_in_episode_5(observation):
    action = np.zeros((len(observation), 2))
    action[5, 1] = np.nan
    return action, None


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (nan_in_episode_5, r"Answer.predict returned nan for action\[1\] at step 0 .*episode 5;"),
        (lambda o: (np.zeros((len(o), 3)), None), r"shape \(1024, 2\), not \(1024, 3\), at step 0"),
        (lambda o: (np.zeros(2), None), r"not \(2,\)"),
        (lambda o: np.zeros((len(o), 2)), r"must return \(action, state\), not ndarray"),
        (lambda o: ("left", None), "no array of numbers"),
    ],
)
def test_a_bad_action_is_named(paper, answer, message):
    with pytest.raises(ValueError, match=message):
        evaluate(Answer(answer), paper, 10)


def test_what_goes_wrong_later_is_named_by_its_step_and_episode(paper):
    class Late:
        observation = "state"

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            action = np.zeros((len(observation), 2))
            action[3, 0] = np.inf if observation[0, 5] > 0.99 else 0.0
            return action, None

    with pytest.raises(ValueError, match=re.escape("action[0] at step 8 (t = 1 s), episode 3")):
        evaluate(Late(), paper, 10)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 0}, "episodes must be at least 1, not 0"),
        ({"episodes": 2.5}, "episodes must be an integer"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"n_jobs": 0}, "n_jobs must be at least 1"),
        ({"batch_size": 0}, "batch_size must be at least 1"),
        ({"substeps": 0}, "substeps must be at least 1"),
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"controller": object()}, "predict"),
        ({"controller": Recorder(rows=3)}, "rows must divide 1024, not 3"),
        ({"controller": Recorder(observation="smell")}, "unknown observation 'smell'"),
    ],
)
def test_bad_arguments_are_named(change, message):
    arguments = {"controller": Recorder(), "scenario": "paper", "episodes": 10, **change}
    with pytest.raises(ValueError, match=message):
        evaluate(**arguments)


def test_an_unbounded_scenario_cannot_scale_actions(paper):
    with pytest.raises(ValueError, match="control_bounds is None"):
        evaluate(Recorder(), paper.replace(control_bounds=None), 10)
