"""Routes: winding numbers, clearance, and trajectories that a car could nearly drive."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slipcar.envs import Scenario, routes, ways

WORLDS = [Scenario.random(seed, turned=True) for seed in (0, 3, 7, 11, 42)]


def disc(x, y, radius=0.3):
    return Scenario(start=np.zeros(5), goal=(4.0, 0.0, 0.0, 0.0, 0.0), obstacles=[(x, y, radius)])


def through(scenario, *points, nodes=200):
    """Positions along the polygon from start over the points to the goal, (nodes, 2)."""
    corners = np.array([scenario.start[:2], *points, scenario.goal[:2]])
    s = np.linspace(0.0, len(corners) - 1.0, nodes)
    return np.column_stack([np.interp(s, np.arange(len(corners)), c) for c in corners.T])


# ---------------------------------------------------------------- homotopy class


def test_class_tells_the_sides_of_an_obstacle():
    world = disc(2.0, 0.2)  # left of the straight line, which passes it on the right
    assert world.homotopy_class(through(world)) == (0,)
    assert world.homotopy_class(through(world, (2.0, -1.0))) == (0,)
    assert world.homotopy_class(through(world, (2.0, 1.0))) == (-1,)
    world = disc(2.0, -0.2)
    assert world.homotopy_class(through(world, (2.0, 1.0))) == (0,)
    assert world.homotopy_class(through(world, (2.0, -1.0))) == (1,)


def test_class_counts_whole_turns():
    world = disc(2.0, 0.2)
    square = [(1.0, -1.0), (3.0, -1.0), (3.0, 1.0), (1.0, 1.0)]  # counter-clockwise
    once = through(world, *square, (1.0, -1.0), nodes=400)
    twice = through(world, *square, *square, (1.0, -1.0), nodes=800)
    clockwise = through(world, *square[::-1], nodes=400)
    assert world.homotopy_class(once) == (1,)
    assert world.homotopy_class(twice) == (2,)
    assert world.homotopy_class(clockwise) == (-1,)


def test_class_names_every_obstacle_and_none():
    world = disc(1.0, 0.3).replace(obstacles=[(1.0, 0.3, 0.2), (3.0, -0.3, 0.2)])
    slalom = through(world, (1.0, 1.0), (3.0, -1.0))
    assert world.homotopy_class(slalom) == (-1, 1)
    assert world.replace(obstacles=[]).homotopy_class(slalom) == ()


@settings(max_examples=60, deadline=None)
@given(data=st.data(), world=st.sampled_from(WORLDS))
def test_class_survives_a_deformation_that_meets_no_centre(data, world):
    # Both ends fixed, every point moved by less than it is away from the nearest centre: the
    # straight-line homotopy between the paths meets none.
    h = data.draw(st.floats(-1.2, 1.2))
    path = routes.arc(world, h)[0][:, :2]
    s = np.linspace(0.0, 1.0, len(path))
    fine = np.column_stack([np.interp(np.linspace(0, 1, 2000), s, c) for c in path.T])
    centres = world.obstacles[:, None, :2]
    room = np.min(np.linalg.norm(fine - centres, axis=-1), axis=0)
    if room.min() < 0.05:  # so close to a centre the nodes of the arc itself may jump over it
        return
    waves = np.array(data.draw(st.lists(st.floats(-1, 1), min_size=6, max_size=6))).reshape(3, 2)
    shift = np.sin(np.pi * np.outer(np.linspace(0, 1, 2000), [1, 2, 5])) @ waves
    shift *= 0.9 * room.min() / max(np.max(np.linalg.norm(shift, axis=-1)), 1e-9)
    assert world.homotopy_class(fine + shift) == world.homotopy_class(fine)


def test_class_changes_by_one_across_a_centre():
    world = disc(2.0, 0.4)
    classes = [world.homotopy_class(through(world, (2.0, y)))[0] for y in (0.0, 0.39, 0.41, 1.0)]
    assert classes == [0, 0, -1, -1]


def test_class_does_not_depend_on_where_the_world_lies():
    rng = np.random.default_rng(0)
    for world in WORLDS:
        path = routes.arc(world, 0.6)[0]
        angle, shift = rng.uniform(-4, 4), rng.normal(size=2)
        R = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

        def move(x, R=R, shift=shift):
            return np.concatenate([x[..., :2] @ R.T + shift, x[..., 2:]], axis=-1)

        moved = world.replace(
            start=move(world.start), goal=move(world.goal), obstacles=move(world.obstacles)
        )
        assert moved.homotopy_class(move(path)) == world.homotopy_class(path)


# ---------------------------------------------------------------- ways


def test_greens_function_solves_the_clamped_beam():
    # r⁗ = δ(s − s₀) with r = r′ = 0 at both ends: the end conditions, by one-sided differences;
    # symmetry; and ∫ G(s, s₀) ds₀ = s²(1 − s)²/24, the beam under an even load.
    G = ways._greens_function(401)
    s = np.linspace(0.0, 1.0, 401)
    np.testing.assert_allclose(G, G.T, atol=1e-16)
    np.testing.assert_allclose(G[[0, -1]], 0.0, atol=1e-16)
    assert np.abs(G[1]).max() < 1e-5
    np.testing.assert_allclose(np.trapezoid(G, s, axis=1), s**2 * (1 - s) ** 2 / 24, atol=1e-9)


def test_a_way_is_the_optimum_of_bending_and_penalty():
    # Against a plain quadratic programme in the nodes: ½ Σ (Δ²r)²/h³ + ½ κ max(0, b − n·r_k)².
    world = disc(2.0, 0.1, 0.5).replace(nodes=201)
    way = next(w for w in ways.ways(world, 4) if len(w.sides) == 1)
    normal = np.array([0.0, float(next(iter(way.sides.values())))])
    reach = 0.5 + world.clearance
    k = int(np.argmin(np.hypot(*(ways.cubic(world) - (2.0, 0.1)).T)))
    h = 1.0 / 200
    D = (np.eye(199, 201) - 2.0 * np.eye(199, 201, 1) + np.eye(199, 201, 2)) / h**2
    ends = 2.0 * np.eye(1, 201, 1) / h**2, 2.0 * np.eye(1, 201, 199) / h**2
    second = np.vstack([ends[0], D, ends[1]])  # of deviations, which vanish at both ends
    lengths = np.full(201, h)
    lengths[[0, -1]] = h / 2
    kappa = ways._stiffness(world, np.array([reach]))[0]
    H = second.T @ (lengths[:, None] * second)
    gain = np.zeros(201)
    gain[k] = 1.0
    y0 = ways.cubic(world)[:, 1]
    rim = normal[1] * 0.1 + reach
    A, b = H + kappa * np.outer(gain, gain), kappa * gain * (normal[1] * rim - y0[k])
    free = slice(1, -1)
    bump = np.zeros(201)
    bump[free] = np.linalg.solve(A[free, free], b[free])
    np.testing.assert_allclose(way.path[:, 1] - y0, bump, atol=2e-3)


# ---------------------------------------------------------------- routes


@pytest.mark.parametrize("world", [*WORLDS, *map(Scenario.named, Scenario.names())])
def test_routes_are_trajectories_of_the_problem(world):
    found = world.guesses(8)
    labels = [label for label, _, _ in found]
    assert 1 <= len(found) <= 8
    assert len(set(labels)) == len(labels)
    for _, x, u in found:
        assert x.shape == (world.nodes, 5)
        assert u.shape == (world.nodes - 1, 2)
        assert np.isfinite(x).all()
        assert np.isfinite(u).all()
        np.testing.assert_array_equal(x[0], world.start)
        np.testing.assert_array_equal(x[-1], world.goal)
        assert np.all(np.abs(u) <= world.control_bounds)


@pytest.mark.parametrize("world", WORLDS)
def test_no_two_routes_share_class_and_heading(world):
    def half_turns(x):
        k = world.nodes // 2
        return round((x[k, 2] - math.atan2(*(x[k + 1] - x[k])[1::-1])) / math.pi)

    kinds = [(world.homotopy_class(x), half_turns(x)) for _, x, _ in world.guesses(16)]
    assert len(set(kinds)) == len(kinds) > 2


def test_routes_come_ranked_and_the_same_each_time():
    world = WORLDS[2]
    few, many, again = world.guesses(3), world.guesses(12), world.guesses(12)
    assert [label for label, _, _ in few] == [label for label, _, _ in many][:3]
    for (a, x, u), (b, y, v) in zip(many, again, strict=True):
        assert a == b
        np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(u, v)


@pytest.mark.parametrize(
    "world",
    [
        disc(2.0, 0.0, 0.5),  # dead centre
        disc(2.0, 0.3, 0.8),
        Scenario.named("gap"),
        Scenario.named("paper"),
        # A wall of four discs with one gap of 0.7 m, off to the left.
        disc(2.0, 0.0).replace(
            obstacles=[(2.0, -1.5, 0.5), (2.0, -0.6, 0.5), (2.0, 0.3, 0.5), (2.0, 2.0, 0.5)]
        ),
    ],
)
def test_a_route_clears_the_obstacles_where_there_is_a_passage(world):
    # It may touch the clearance ring, as plans do, which only pay for that.
    clear = [
        world.signed_distance(x).min() >= 0.5 * world.clearance for _, x, _ in world.guesses(8)
    ]
    assert clear[0]


def test_both_sides_of_a_single_obstacle_are_offered():
    world = disc(2.0, 0.1, 0.4)
    assert {(0,), (-1,)} <= {world.homotopy_class(x) for _, x, _ in world.guesses(4)}


def test_a_route_that_starts_and_ends_along_itself_obeys_the_dynamics():
    # The headings of both ends fit the way: nothing has to be blended, and the guess is a motion
    # of the car but for the first and last step, where its speed is the given one.
    for goal in ((4.0, 0.0, 0.0, 0.0, 0.0), (-4.0, 0.0, 0.0, 0.0, 0.0)):
        world = Scenario(start=np.zeros(5), goal=goal, control_bounds=None)
        x, u = routes.arc(world, 0.0)
        defect = x[1:] - x[:-1] - world.dt * world.drift(None, x[:-1], u)
        np.testing.assert_allclose(defect[1:-1], 0.0, atol=1e-12)
        assert np.sign(x[20, 3]) == np.sign(goal[0])


def test_speeds_follow_from_controls_and_turned_headings_are_met():
    world = WORLDS[1].replace(control_bounds=None)
    x, u = routes.arc(world, 0.4)
    defect = x[1:] - x[:-1] - world.dt * world.drift(None, x[:-1], u)
    np.testing.assert_allclose(defect[1:-1, 2:], 0.0, atol=1e-12)
    assert np.abs(np.diff(x[:, 2])).max() < 0.5  # no jump of a full turn on the way


@pytest.mark.parametrize("half_turns", [-3, -2, -1, 0, 1, 2, 3])
def test_odd_half_turns_drive_backwards_along_the_same_way(half_turns):
    world = WORLDS[0]
    path = routes.arc(world, 0.4)[0][:, :2]
    x, _ = routes.trajectory(world, path, half_turns)
    k = world.nodes // 2
    velocity = world.drift(None, x[k], np.zeros(2))[:2]
    assert np.sign(x[k, 3]) == (1.0 if half_turns % 2 == 0 else -1.0)
    np.testing.assert_allclose(velocity, (path[k + 1] - path[k]) / world.dt, atol=1e-9)


def test_arc_bulges_to_its_side():
    world = disc(2.0, 3.0)
    assert routes.arc(world, 0.5)[0][:, 1].max() == pytest.approx(2.0, rel=1e-3)
    assert routes.arc(world, -0.5)[0][:, 1].min() == pytest.approx(-2.0, rel=1e-3)
    np.testing.assert_allclose(routes.arc(world, 0.0)[0][:, 1], 0.0, atol=1e-12)


@pytest.mark.parametrize("obstacles", [[], [(0.5, 0.4, 0.2)]])
def test_round_trip_and_bare_minimum_of_nodes(obstacles):
    there_and_back = Scenario(start=np.zeros(5), goal=np.zeros(5), obstacles=obstacles)
    for world in (there_and_back, disc(2.0, 0.1).replace(nodes=2)):
        for _, x, u in world.guesses(4):
            assert np.isfinite(x).all()
            assert np.isfinite(u).all()
