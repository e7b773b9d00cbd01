"""Several starts: guesses that are fit to start from, and the best plan of all."""

import dataclasses

import numpy as np
import pytest

from slipcar.envs import Scenario, routes
from slipcar.planner import Status, plan
from slipcar.planner.homotopy import free_path, has_penalties
from slipcar.planner.problem import model_of
from slipcar.planner.starts import (
    Guess,
    alternatives,
    best_of,
    initial_guesses,
    multistart,
    objective,
    solve_all,
)

WALL = Scenario(
    start=np.zeros(5),
    goal=(4.0, 0.0, 0.0, 0.0, 0.0),
    obstacles=[(2.0, 0.15, 0.4), (2.0, -1.0, 0.3)],
)


class Particle:
    """A point of unit mass in the plane, and a disc to get past: nothing offers any guesses."""

    def __init__(self, centre=(0.5, 0.02), radius=0.2, **members):
        self.start = np.zeros(4)
        self.times = np.linspace(0.0, 1.0, 26) ** 1.2
        self.control_weight = np.eye(2)
        self.centre, self.radius = np.array(centre), radius
        self.penalty_weight = np.array([3e4])
        self.__dict__.update(members)

    def drift(self, t, x, u):
        return np.concatenate([x[..., 2:], u], axis=-1)

    def diffusion(self, t, x):
        return np.zeros((*x.shape[:-1], 4, 1))

    def terminal(self, x):
        return x - np.array([1.0, 0.0, 0.0, 0.0])

    def penalty(self, t, x):
        offset = x[..., :2] - self.centre
        return (self.radius**2 - np.sum(offset * offset, axis=-1))[..., None]

    def initial_guess(self):
        s = self.times[:, None]
        return s * np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((len(self.times) - 1, 2))


# ---------------------------------------------------------------- guesses


@pytest.mark.parametrize("problem", [WALL, Scenario.named("paper"), Particle()])
@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_guesses_are_fit_to_start_from(problem, count):
    model = model_of(problem)
    found = initial_guesses(problem, count)
    assert 1 <= len(found) <= count
    assert len({guess.label for guess in found}) == len(found)
    for guess in found:
        assert guess.states.shape == (len(model.times), len(model.start))
        assert guess.controls.shape == (len(model.times) - 1, len(model.R))
        np.testing.assert_array_equal(guess.states[0], model.start)
        assert np.isfinite(guess.states).all()
        assert np.all((guess.controls >= model.lower) & (guess.controls <= model.upper))


@pytest.mark.parametrize("problem", [WALL, Particle()])
def test_more_guesses_begin_with_the_fewer_and_repeat(problem):
    few, many, again = (initial_guesses(problem, k) for k in (3, 8, 8))
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.states, b.states)
    for a, b in zip(many, again, strict=True):
        assert a.label == b.label
        np.testing.assert_array_equal(a.states, b.states)
        np.testing.assert_array_equal(a.controls, b.controls)


def test_own_guess_is_first_and_free_of_penalties_only_where_there_are_some():
    with_penalties, without = initial_guesses(WALL, 2), initial_guesses(Scenario.named("open"), 2)
    assert [guess.free_first for guess in with_penalties] == [True, False]
    assert not any(guess.free_first for guess in without)
    for guess in (*with_penalties, without[0]):
        owner = WALL if guess in with_penalties else Scenario.named("open")
        np.testing.assert_array_equal(guess.states, owner.initial_guess()[0])
    assert has_penalties(WALL)
    assert not has_penalties(WALL.replace(obstacle_weight=0.0))
    assert not has_penalties(Particle(penalty=None))


def test_bumps_are_smooth_keep_both_ends_and_go_both_ways():
    problem = Particle()
    x, _ = problem.initial_guess()
    bumps = [g.states - x for g in initial_guesses(problem, 12) if g.label.startswith("bump")]
    assert len(bumps) == 10
    for bump in bumps:
        np.testing.assert_allclose(bump[[0, -1]], 0.0, atol=1e-12)
        assert np.abs(np.diff(bump, axis=0)).max() < np.abs(bump).max()
    sideways = [bump[:, 1].sum() for bump in bumps]
    assert min(sideways) < 0.0 < max(sideways)


def test_guesses_along_which_the_model_is_not_finite_are_left_out():
    class Halfplane(Particle):
        def drift(self, t, x, u):
            with np.errstate(invalid="ignore"):
                return super().drift(t, x, u) + 0.0 * np.sqrt(x[..., 1:2] + 1e-9)

    guesses = initial_guesses(Halfplane(), 6)
    assert len(guesses) < 6 or all(g.states[:, 1].min() >= -1e-9 for g in guesses)
    for guess in guesses:
        assert guess.states[:, 1].min() >= -1e-9


@pytest.mark.parametrize("count", [0, -1, 1.5, "8", True, None])
def test_bad_number_of_starts(count):
    with pytest.raises(ValueError, match=r"starts must be an integer >= 1"):
        initial_guesses(WALL, count)


def test_a_guess_of_the_wrong_shape_from_the_problem_is_named():
    problem = Particle(guesses=lambda count: [("short", np.zeros((3, 4)), np.zeros((2, 2)))])
    with pytest.raises(ValueError, match="guess: states"):
        initial_guesses(problem, 3)


# ---------------------------------------------------------------- without penalties first


def test_free_path_is_the_answer_without_penalties():
    free = free_path(WALL, WALL.initial_guess(), variance_weight=0.0)
    exact = plan(WALL.replace(obstacles=[]), variance_weight=0.0, tolerance=1e-8)
    assert free.iterations <= 10
    assert free.effort == pytest.approx(exact.effort, rel=0.02)
    assert WALL.signed_distance(free.mean).min() < 0.0  # right through


def test_free_path_of_a_particle_is_the_straight_line_at_the_speed_of_a_cubic():
    # Least ∫ ‖a‖² dt from rest to rest: 3 s² − 2 s³, here on a time grid that is not even.
    free = free_path(Particle(), Particle().initial_guess())
    t = Particle().times
    np.testing.assert_allclose(free.mean[:, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(free.mean[:, 0], 3.0 * t**2 - 2.0 * t**3, atol=0.05)


# ---------------------------------------------------------------- the best of all


@pytest.mark.parametrize("seed", [4, 15, 22, 23, 42, 58])
def test_several_starts_are_never_worse_than_one(seed):
    world = Scenario.random(seed, turned=True)
    one = plan(world, variance_weight=0.0, tolerance=1e-6)
    several, tried = multistart(world, 6, variance_weight=0.0, tolerance=1e-6)
    assert several.status is Status.CONVERGED
    assert several.cost <= one.cost * (1.0 + 1e-6)
    assert objective(several) == tried[0].cost
    assert len(tried) == 6


def test_several_starts_beat_one_where_the_straight_way_is_the_wrong_one():
    # At least one of many worlds must show the difference for which there are several starts.
    gains = []
    for seed in (15, 22, 42, 58):
        world = Scenario.random(seed, turned=True)
        one = plan(world, variance_weight=0.0)
        gains.append(one.cost / multistart(world, 8, variance_weight=0.0)[0].cost)
    assert max(gains) > 1.5


def test_all_ways_round_a_disc_are_found_and_ranked():
    _, tried = multistart(WALL, 8)
    converged = [a for a in tried if a.status is Status.CONVERGED]
    costs = [a.cost for a in converged]
    assert costs == sorted(costs)
    # Between the discs, left of both, right of both.
    distinct = {a.homotopy for a in converged}
    assert {(0, 0), (-1, 0), (0, 1)} <= distinct


def test_same_answers_are_marked_and_different_ones_are_not():
    _, tried = multistart(WALL, 8, variance_weight=0.0, tolerance=1e-8)
    by_label = {a.label: a for a in tried}
    assert tried[0].same_as is None
    for a in tried:
        if a.same_as is not None:
            twin = by_label[a.same_as]
            assert twin.same_as is None
            assert twin.homotopy == a.homotopy
            assert twin.cost == pytest.approx(a.cost, rel=2e-3)
    unmarked = [(a.homotopy, a.cost) for a in tried if a.same_as is None]
    for i, (h, c) in enumerate(unmarked):
        assert all(h != k or abs(c - d) > 1e-3 * max(c, d) for k, d in unmarked[:i])


def test_particle_passes_on_the_near_side_whatever_its_straight_guess_says():
    # Symmetry: a disc whose centre is above the line is passed below, and the other way round.
    for height in (0.05, -0.05):
        problem = Particle(centre=(0.5, height), radius=0.25)
        best, tried = multistart(problem, 8, tolerance=1e-8)
        assert best.status is Status.CONVERGED
        assert np.sign(best.mean[np.argmin(np.abs(best.mean[:, 0] - 0.5)), 1]) == -np.sign(height)
        assert all(a.homotopy is None for a in tried)
        sides = {round(a.cost, 2) for a in tried if a.same_as is None and a.status.ok}
        assert len(sides) >= 2  # both sides were found


def test_mirrored_particles_have_the_same_best_cost():
    above, below = (
        multistart(Particle(centre=(0.5, y), radius=0.25), 8, tolerance=1e-9)[0].cost
        for y in (0.05, -0.05)
    )
    assert above == pytest.approx(below, rel=1e-5)


def test_one_start_is_the_own_guess_and_a_free_path_counts_in_its_iterations():
    guesses = initial_guesses(WALL, 1)
    (only,) = solve_all(WALL, guesses, tolerance=1e-6)
    free = free_path(WALL, WALL.initial_guess())
    after = plan(WALL, guess=(free.mean, free.controls), cold_start="never", tolerance=1e-6)
    assert only.iterations == len(only.history) == free.iterations + after.iterations
    np.testing.assert_allclose(only.controls, after.controls, atol=1e-9)
    np.testing.assert_array_equal(only.guess, WALL.initial_guess()[0])


def test_options_reach_every_start():
    found, tried = multistart(WALL, 3, variance_weight=2.0, max_iterations=2, tolerance=1e-12)
    assert found.options["variance_weight"] == 2.0
    assert all(a.status is Status.MAX_ITERATIONS for a in tried)
    assert objective(found) == pytest.approx(found.cost + 2.0 * found.variance)


def test_a_converged_plan_beats_a_cheaper_one_that_is_not():
    good = plan(WALL, variance_weight=0.0)
    cheap = good.replace(status=Status.MAX_ITERATIONS, effort=0.0, obstacle_cost=0.0)
    assert best_of([cheap, good]) is good
    dear = good.replace(effort=good.effort + 1.0)
    assert best_of([dear, cheap, good]) is good


def test_of_plans_that_failed_the_one_that_misses_least_is_returned():
    good = plan(WALL, variance_weight=0.0)
    last = good.history[-1]

    def failed(miss, effort):
        end = dataclasses.replace(last, terminal_residual=miss)
        return good.replace(status=Status.STALLED, effort=effort, history=(end,))

    far, near, dear, lost = failed(2.0, 1.0), failed(0.5, 1.0), failed(0.5, 3.0), failed(np.nan, 0)
    assert best_of([far, lost, dear, near]) is near
    assert best_of([lost]) is lost
    with pytest.raises(ValueError, match="at least one plan"):
        best_of([])


def test_alternatives_report_what_failed():
    guesses = [Guess("left", *routes.arc(WALL, 0.5)), Guess("right", *routes.arc(WALL, -0.5))]
    plans = solve_all(WALL, guesses)
    plans[0] = plans[0].replace(status=Status.STALLED)
    rows = alternatives(WALL, guesses, plans)
    assert [(row.label, row.status.ok) for row in rows] == [("right", True), ("left", False)]
    assert rows[0].homotopy == WALL.homotopy_class(plans[1].mean)


def test_an_offered_guess_that_is_the_own_one_again_is_left_out():
    x, u = Particle().initial_guess()
    offered = [("own again", x, u), ("above", x + np.array([0.0, 0.1, 0.0, 0.0]), u)]
    labels = [g.label for g in initial_guesses(Particle(guesses=lambda count: offered), 8)]
    assert labels == ["own, free first", "own", "above"]
