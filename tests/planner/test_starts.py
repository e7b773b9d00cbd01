"""Several starts: guesses that are fit to start from, and the best plan of all."""

import numpy as np
import pytest

from slipcar.envs import Scenario, routes
from slipcar.planner import Status, plan
from slipcar.planner.problem.model import model_of
from slipcar.planner.search import starts

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


def initial_guesses(problem, count):
    return starts.initial_guesses(model_of(problem), count)


def multistart(problem, count, **options):
    found = plan(problem, starts=count, **options)
    return found, found.alternatives


def objective(found):
    return found.cost + found.options["variance_weight"] * found.variance


# ---------------------------------------------------------------- guesses


@pytest.mark.parametrize("problem", [WALL, Scenario.named("paper"), Particle()])
@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_guesses_are_fit_to_start_from(problem, count):
    model = model_of(problem)
    found = initial_guesses(problem, count)
    twice = 1 if model.weight.any() else 0  # the own one, with and without its penalties
    assert 1 + twice <= len(found) <= count + twice
    assert len({guess.label for guess in found}) == len(found)
    for guess in found:
        assert guess.x.shape == (len(model.times), len(model.start))
        assert guess.u.shape == (len(model.times) - 1, len(model.R))
        np.testing.assert_array_equal(guess.x[0], model.start)
        assert np.isfinite(guess.x).all()
        assert np.all((guess.u >= model.lower) & (guess.u <= model.upper))


@pytest.mark.parametrize("problem", [WALL, Particle()])
def test_more_guesses_begin_with_the_fewer_and_repeat(problem):
    few, many, again = (initial_guesses(problem, k) for k in (3, 8, 8))
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.x, b.x)
    for a, b in zip(many, again, strict=True):
        assert a.label == b.label
        np.testing.assert_array_equal(a.x, b.x)
        np.testing.assert_array_equal(a.u, b.u)


def test_own_guess_is_first():
    for problem in (WALL, Scenario.named("open"), Particle()):
        first, *others = initial_guesses(problem, 5)
        np.testing.assert_array_equal(first.x, problem.initial_guess()[0])
        assert first.free_first
        # The others were made to lie on a side: the penalties must hold them there.
        assert not any(guess.free_first for guess in others)


def test_bumps_are_smooth_keep_both_ends_and_go_both_ways():
    problem = Particle()
    x, _ = problem.initial_guess()
    bumps = [g.x - x for g in initial_guesses(problem, 11) if g.label.startswith("bump")]
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
    assert len(guesses) < 6 or all(g.x[:, 1].min() >= -1e-9 for g in guesses)
    for guess in guesses:
        assert guess.x[:, 1].min() >= -1e-9


@pytest.mark.parametrize("count", [0, -1, 1.5, "8", True])
def test_bad_number_of_starts(count):
    with pytest.raises(ValueError, match=r"starts must be an integer >= 1"):
        plan(WALL, starts=count)


def test_several_starts_and_a_guess_exclude_each_other():
    with pytest.raises(ValueError, match="starts > 1 and guess"):
        plan(WALL, starts=2, guess=WALL.initial_guess())


def test_a_guess_of_the_wrong_shape_from_the_problem_is_named():
    problem = Particle(guesses=lambda count: [("short", np.zeros((3, 4)), np.zeros((2, 2)))])
    with pytest.raises(ValueError, match="guess: states"):
        initial_guesses(problem, 3)


# ---------------------------------------------------------------- without penalties first


def test_first_steps_lead_to_the_answer_without_penalties():
    problem = WALL.replace(obstacles=[(2.0, 0.1, 0.4)])
    exact = plan(problem.replace(obstacles=[]), variance_weight=0.0, tolerance=1e-8)
    paths = [h.mean for h in plan(problem, variance_weight=0.0).history]
    assert min(np.abs(path - exact.mean).max() for path in paths) < 0.02
    assert WALL.signed_distance(exact.mean).min() < 0.0  # right through


def test_leaving_penalties_out_first_forgets_the_side_of_the_guess():
    def sides(free_first):
        options = {"free_first": free_first, "cold_start": "never", "tolerance": 1e-8}
        found = [plan(WALL, guess=routes.arc(WALL, bulge), **options) for bulge in (0.6, -0.6)]
        assert all(p.status.ok for p in found)
        return {WALL.homotopy_class(p.mean) for p in found}

    assert len(sides(False)) == 2
    assert len(sides(True)) == 1


@pytest.mark.parametrize("method", ["newton", "convex"])
def test_penalties_that_weigh_nothing_change_nothing(method):
    open_world = WALL.replace(obstacle_weight=0.0)
    a, b = (
        plan(open_world, free_first=first, method=method, tolerance=1e-8) for first in (True, False)
    )
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-6)


# ---------------------------------------------------------------- the best of all


@pytest.mark.parametrize("seed", [4, 15, 22, 24, 28, 60])
def test_several_starts_are_never_worse_than_one(seed):
    world = Scenario.random(seed, turned=True)
    one = plan(world, variance_weight=0.0, tolerance=1e-6)
    several, tried = multistart(world, 6, variance_weight=0.0, tolerance=1e-6)
    assert several.status is Status.CONVERGED
    assert several.cost <= one.cost * (1.0 + 1e-6)
    assert objective(several) == tried[0].cost
    assert 2 <= len(tried) <= 2 * 7  # some twice, where bold steps left the way


def test_several_starts_beat_one_where_the_straight_way_is_the_wrong_one():
    # At least one of many worlds must show the difference for which there are several starts.
    gains = []
    for seed in (24, 28, 60, 84):
        world = Scenario.random(seed, turned=True)
        one = plan(world, variance_weight=0.0)
        gains.append(one.cost / multistart(world, 8, variance_weight=0.0)[0].cost)
    assert max(gains) > 1.5


def test_all_ways_round_a_disc_are_found_and_ranked():
    _, tried = multistart(WALL, 8)
    converged = [a for a in tried if a.status is Status.CONVERGED]
    costs = [a.cost for a in converged]
    assert costs == sorted(costs)
    # Between the discs lies the straight line; left and right of both are ways, too.
    distinct = {a.homotopy for a in converged}
    assert len(distinct) >= 2
    assert (0, 0) in distinct


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
        best, tried = multistart(problem, 16, tolerance=1e-8)
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


def test_options_reach_every_start():
    found, tried = multistart(WALL, 3, variance_weight=2.0, max_iterations=2, tolerance=1e-12)
    assert found.options["variance_weight"] == 2.0
    assert all(a.status is Status.MAX_ITERATIONS for a in tried)
    assert objective(found) == pytest.approx(found.cost + 2.0 * found.variance)


def test_a_converged_start_beats_cheaper_ones_that_are_not():
    # One offered guess from which too few iterations are left; the own one converges.
    found, tried = multistart(WALL, 8, max_iterations=9, variance_weight=0.0)
    ended = [row.status.ok for row in tried]
    assert found.status.ok
    assert not all(ended)  # otherwise this shows nothing
    assert ended == sorted(ended, reverse=True)
    assert tried[0].cost == pytest.approx(objective(found))


def test_an_offered_guess_that_is_the_own_one_again_is_left_out():
    x, u = Particle().initial_guess()
    offered = [("own again", x, u), ("above", x + np.array([0.0, 0.1, 0.0, 0.0]), u)]
    labels = [g.label for g in initial_guesses(Particle(guesses=lambda count: offered), 8)]
    assert labels == ["own", "own, penalties in", "above"]
