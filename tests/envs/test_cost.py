"""Costs, clearance and collision: formulas by hand, symmetries, NumPy and Torch alike."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from slipcar.envs import Scenario, cost, transition

PAPER = Scenario.named("paper")
SHAPES = [(), (5,), (3, 4), (2, 1, 3), (0,)]


def states(shape, seed=0):
    return np.random.default_rng(seed).uniform(-1, 4, (*shape, 5))


def moved(x, angle, shift):
    """States after turning the world by `angle` about the origin and shifting it."""
    R = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    out = np.array(x)
    out[..., :2] = x[..., :2] @ R.T + shift
    return out


def test_obstacle_cost_by_hand():
    obstacles = np.array([[1.0, 0.0, 0.3], [0.0, 2.0, 0.5]])
    x = np.array([0.8, 0.0, 9.0, 9.0, 9.0])  # 0.2 m from the first centre, far from the second
    expected = 500.0 * ((0.3 + 0.1) ** 2 - 0.2**2) ** 2
    np.testing.assert_allclose(cost.obstacle_power(x, obstacles, 0.1, 500.0), expected, rtol=1e-13)


def test_obstacle_cost_adds_up_over_overlapping_obstacles():
    obstacles = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5], [5.0, 0.0, 0.5]])
    x = states((50,)) * 0.2
    alone = sum(cost.obstacle_power(x, obstacles[i : i + 1], 0.1, 7.0) for i in range(3))
    np.testing.assert_allclose(cost.obstacle_power(x, obstacles, 0.1, 7.0), alone, rtol=1e-12)


@given(st.floats(0, 2 * math.pi), st.floats(0.0, 3.0))
def test_obstacle_cost_is_zero_exactly_outside_the_clearance_ring(angle, distance):
    radius, clearance = 0.3, 0.13
    obstacles = np.array([[1.0, -2.0, radius]])
    x = np.zeros(5)
    x[:2] = obstacles[0, :2] + distance * np.array([math.cos(angle), math.sin(angle)])
    value = cost.obstacle_power(x, obstacles, clearance, 500.0)
    if distance > radius + clearance + 1e-9:
        assert value == 0.0
    if distance < radius + clearance - 1e-6:
        assert value > 0.0


@given(st.floats(0, 2 * math.pi), st.floats(0.0, 3.0), st.floats(0.0, 1.0))
def test_collision_uses_the_bare_radius(angle, distance, clearance):
    radius = 0.3
    scenario = PAPER.replace(obstacles=[[1.0, -2.0, radius]], clearance=clearance)
    x = np.zeros(5)
    x[:2] = scenario.obstacles[0, :2] + distance * np.array([math.cos(angle), math.sin(angle)])
    signed = scenario.signed_distance(x)
    np.testing.assert_allclose(signed, distance - radius, atol=1e-12)
    assert signed == PAPER.replace(obstacles=scenario.obstacles, clearance=0).signed_distance(x)


def test_signed_distance_is_to_the_nearest_rim_and_infinite_without_obstacles():
    obstacles = np.array([[0.0, 0.0, 1.0], [3.0, 0.0, 0.1]])
    x = np.array([[2.5, 0, 0, 0, 0], [0.5, 0, 0, 0, 0], [0, 4, 0, 0, 0]], dtype=float)
    np.testing.assert_allclose(cost.signed_distance(x, obstacles), [0.4, -0.5, 3.0], rtol=1e-12)
    assert (cost.signed_distance(x, np.zeros((0, 3))) == np.inf).all()
    assert (cost.obstacle_power(x, np.zeros((0, 3)), 0.1, 500.0) == 0.0).all()


@given(
    arrays(float, (6, 5), elements=st.floats(-3, 3)),
    arrays(float, (4, 2), elements=st.floats(-3, 3)),
    arrays(float, 4, elements=st.floats(0.01, 2)),
    st.floats(-10, 10),
    st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
)
def test_turning_and_shifting_the_world_changes_neither_cost_nor_clearance(
    x, centres, radii, angle, shift
):
    here = np.column_stack([centres, radii])
    there = np.column_stack([moved(centres, angle, shift), radii])
    y = moved(x, angle, shift)
    np.testing.assert_allclose(
        cost.signed_distance(y, there), cost.signed_distance(x, here), atol=1e-10
    )
    np.testing.assert_allclose(
        cost.obstacle_power(y, there, 0.13, 500.0),
        cost.obstacle_power(x, here, 0.13, 500.0),
        rtol=1e-9,
        atol=1e-6,
    )


@given(st.permutations(range(4)))
def test_the_order_of_obstacles_does_not_matter(order):
    x = states((30,))
    shuffled = PAPER.replace(obstacles=PAPER.obstacles[list(order)])
    np.testing.assert_array_equal(shuffled.signed_distance(x), PAPER.signed_distance(x))
    np.testing.assert_allclose(shuffled.obstacle_power(x), PAPER.obstacle_power(x), rtol=1e-12)


def test_goal_cost_is_the_weighted_square_and_zero_at_the_goal():
    weight = (1.0, 2.0, 3.0, 4.0, 5.0)
    scenario = PAPER.replace(goal_weight=weight)
    e = np.array([0.1, -0.2, 0.3, -0.4, 0.5])
    expected = e @ np.diag(weight) @ e
    np.testing.assert_allclose(scenario.goal_cost(scenario.goal + e), expected, rtol=1e-12)
    assert scenario.goal_cost(scenario.goal) == 0.0


def test_effort_is_the_squared_norm():
    u = np.random.default_rng(0).normal(size=(6, 2))
    np.testing.assert_allclose(PAPER.control_power(u), np.linalg.norm(u, axis=-1) ** 2)


@pytest.mark.parametrize("shape", SHAPES)
def test_obstacle_constraint_jacobian_and_gradient_of_the_cost(shape):
    x = states(shape)
    jacobian = cost.obstacle_constraints_jacobian(x, PAPER.obstacles)
    assert jacobian.shape == (*shape, 4, 5)
    c = PAPER.penalty(0.0, x)
    gradient = 2 * PAPER.obstacle_weight * np.einsum("...k,...kn->...n", np.maximum(c, 0), jacobian)
    for j in range(5):
        y = x.astype(complex)
        y[..., j] += 1e-30j
        np.testing.assert_allclose(PAPER.penalty(0.0, y).imag / 1e-30, jacobian[..., j], atol=1e-13)
        slope = PAPER.obstacle_power(y).imag / 1e-30
        np.testing.assert_allclose(slope, gradient[..., j], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("substeps", [1, 3])
def test_torch_gives_numpys_numbers(shape, substeps):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(3)
    x, u = states(shape), rng.normal(size=(*shape, 2))
    noise = rng.normal(size=(*shape, substeps, 3))
    X, U, Z = (torch.from_numpy(a) for a in (x, u, noise))
    reference, ours = transition(PAPER, x, u, noise), transition(PAPER, X, U, Z)
    pairs = [
        (PAPER.control_power(U), PAPER.control_power(u)),
        (PAPER.obstacle_power(X), PAPER.obstacle_power(x)),
        (PAPER.goal_cost(X), PAPER.goal_cost(x)),
        (PAPER.signed_distance(X), PAPER.signed_distance(x)),
        (PAPER.penalty(0.0, X), PAPER.penalty(0.0, x)),
        (PAPER.penalty_jacobian(0.0, X), PAPER.penalty_jacobian(0.0, x)),
        (PAPER.terminal(X), PAPER.terminal(x)),
        (PAPER.terminal_jacobian(X), PAPER.terminal_jacobian(x)),
        (PAPER.diffusion(0.0, X), PAPER.diffusion(0.0, x)),
        (PAPER.diffusion_jacobian(0.0, X), PAPER.diffusion_jacobian(0.0, x)),
        (ours.state, reference.state),
        (ours.effort, reference.effort),
        (ours.obstacle, reference.obstacle),
        (ours.distance, reference.distance),
    ]
    for tensor, array in pairs:
        assert isinstance(tensor, torch.Tensor)
        assert tensor.dtype == torch.float64
        np.testing.assert_allclose(tensor.numpy(), array, rtol=1e-12, atol=1e-12)


def test_a_path_is_differentiable_in_torch():
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    noise = torch.from_numpy(rng.normal(size=(PAPER.nodes - 1, 1, 3)))
    plan = 0.5 * rng.normal(size=(PAPER.nodes - 1, 2))

    def path_cost(controls):
        x, total = torch.from_numpy(PAPER.start.copy()), torch.zeros((), dtype=torch.float64)
        for u, z in zip(controls, noise, strict=True):
            step = transition(PAPER, x, u, z)
            x, total = step.state, total + step.effort + step.obstacle
        return total + PAPER.goal_cost(x)

    controls = torch.from_numpy(plan).requires_grad_()
    path_cost(controls).backward()
    direction = rng.normal(size=plan.shape)
    h = 1e-6
    with torch.no_grad():
        ahead = path_cost(torch.from_numpy(plan + h * direction))
        behind = path_cost(torch.from_numpy(plan - h * direction))
    slope = float(ahead - behind) / (2 * h)
    np.testing.assert_allclose(float((controls.grad.numpy() * direction).sum()), slope, rtol=1e-5)
