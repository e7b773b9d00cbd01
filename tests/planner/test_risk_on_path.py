"""Risk at every instant: first passages in closed form, and promises that the SDE keeps."""

import dataclasses
import types

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import Feedback, OpenLoop, Plan, Status, plan
from slipcar.planner.moments import monte_carlo
from slipcar.planner.moments.bridge import OVERSHOOT, crossing
from slipcar.planner.moments.monte_carlo import BLOCK, Law, control_of
from slipcar.planner.newton.paths import CompiledPaths
from slipcar.planner.newton.posing import pose
from slipcar.planner.problem.model import model_of

FEW = 20_000


def drifting(speed=0.5, noise=1.0, wall=1.5, nodes=5):
    """dx = u dt + noise dB in one dimension, y = −x beside it, to stay below `wall`."""
    return types.SimpleNamespace(
        start=np.zeros(2),
        times=np.linspace(0.0, 1.0, nodes),
        control_weight=np.eye(1),
        drift=lambda t, x, u: np.concatenate([u, -u], axis=-1),
        diffusion=lambda t, x: np.stack([0.0 * x + noise, 0.0 * x - noise], axis=-1)[..., :1],
        terminal=lambda x: x[..., :1] - speed,
        constraint=lambda t, x: np.stack([x[..., 0] - wall, -10.0 + 0.0 * x[..., 1]], axis=-1),
    )


def steady(problem, speed):
    """The law u = speed, whatever happens."""
    K, n = len(problem.times) - 1, len(problem.start)
    return Law(np.zeros((K + 1, n)), np.full((K, 1), speed), np.zeros((K, 1, n)))


def passage(speed, noise, wall):
    """P(a Brownian motion with drift reaches a wall within a second): Borodin, Salminen 2.1.1.4."""
    down = norm.cdf((speed - wall) / noise)
    return down + np.exp(2.0 * speed * wall / noise**2) * norm.cdf((-speed - wall) / noise)


def compiled(problem, law, integrator="midpoint"):
    model = dataclasses.replace(model_of(problem), integrator=integrator)
    return CompiledPaths(pose(model, constraints=True), law)


# ------------------------------------------------------------------------------------ the bridge


def test_a_bridge_touches_as_a_sampled_one_does():
    rng, points, a, b, V = np.random.default_rng(0), 1000, 0.7, 0.4, 0.8
    steps = rng.normal(size=(4000, points)) * np.sqrt(V / points)
    walk = np.cumsum(steps, axis=1)
    share = np.arange(1, points + 1) / points
    lowest = (a + walk + share * (b - a - walk[:, -1:])).min(axis=1)
    q = crossing(np.array([a]), np.array([b]), np.array([V]))[0]
    missed = OVERSHOOT * np.sqrt(V / points)  # between the points
    assert abs((lowest < missed).mean() - q) < 4.0 * np.sqrt(q / 4000)


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.0, 1.0))
def test_a_bridge_is_a_probability(a, b, V):
    (q,) = crossing(np.array([a]), np.array([b]), np.array([V]))
    assert 0.0 <= q <= 1.0
    if min(a, b) <= 0.0:
        assert q == 1.0
    elif V == 0.0:
        assert q == 0.0


# -------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("speed", [-0.5, 0.0, 1.0])
@pytest.mark.parametrize("substeps", [1, 2, 8])
def test_a_first_passage_is_met_in_any_number_of_substeps(speed, substeps):
    """Constant drift and noise: bridges make it exact, where nodes alone see a part."""
    problem = drifting(noise=0.8)
    paths = compiled(problem, steady(problem, speed))
    kept = [paths.path(7, block, substeps, False)[0] for block in range(20)]
    broken = 1.0 - np.concatenate([each.path for each in kept])
    truth = passage(speed, 0.8, 1.5)
    assert abs(broken.mean() - truth) < 4.0 * broken.std() / np.sqrt(len(broken))
    at_nodes = 1.0 - np.mean([each.nodes for each in kept])
    assert at_nodes < 0.9 * truth


def test_finer_and_coarser_paths_see_one_brownian_motion():
    """Their ends are the same where drift and noise are constant: so is what nodes see."""
    problem = drifting()
    fine, coarse = compiled(problem, steady(problem, 0.5)).path(3, 0, 8, True)
    np.testing.assert_array_equal(fine.nodes, coarse.nodes)
    assert not np.array_equal(fine.path, coarse.path)
    assert abs(fine.path.mean() - coarse.path.mean()) < 0.01


def test_a_start_behind_the_wall_breaks_the_path():
    problem = drifting(wall=-0.1, noise=1e-3)
    paths = compiled(problem, steady(problem, -2.0))
    assert not paths.path(0, 0, 2, False)[0].path.any()
    assert paths.path(0, 0, 2, False)[0].nodes.all()  # nodes 1..N−1 lie before it


# --------------------------------------------------------------------- machine code and NumPy


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("feedback", [False, True])
def test_machine_code_drives_as_numpy_does(paper, integrator, feedback):
    p = plan(paper, expected=True, feedback=feedback, integrator=integrator)
    gains = np.zeros((*p.controls.shape, 5)) if p.gains is None else p.gains
    law = Law(p.mean, p.controls, gains)
    model = dataclasses.replace(model_of(paper), integrator=integrator)
    control, fast = control_of(model, law), compiled(paper, law, integrator)
    np.testing.assert_array_equal(fast.chain(1, 2), monte_carlo.chain(model, control, 1, 2))
    pairs = zip(
        fast.path(1, 2, 2, True), monte_carlo.path(model, control, 1, 2, 2, True), strict=True
    )
    for quick, slow in pairs:
        np.testing.assert_allclose(quick.path, slow.path, atol=1e-9)
        np.testing.assert_array_equal(quick.nodes, slow.nodes)


def test_what_is_no_longer_finite_is_broken():
    problem = drifting()
    problem.drift = lambda t, x, u: np.concatenate([u, u * np.exp(1e3 * x[..., 1:])], axis=-1)
    law = steady(problem, 10.0)
    model = dataclasses.replace(model_of(problem), integrator="midpoint")
    with np.errstate(all="ignore"):
        slow = monte_carlo.path(model, control_of(model, law), 0, 0, 2)[0]
    quick = compiled(problem, law).path(0, 0, 2, False)[0]
    for kept in (quick, slow):
        assert not kept.path.any()
        assert not np.isnan(kept.nodes).any()


# ------------------------------------------------------------------------------------- promises


def chance(p, scenario, episodes=10_000, substeps=64):
    """By Euler's method in many substeps, with bridges."""
    gains = np.zeros((*p.controls.shape, 5)) if p.gains is None else p.gains
    paths = compiled(scenario, Law(p.mean, p.controls, gains), "euler")
    blocks = range(-(-episodes // BLOCK))
    return 1.0 - np.mean([paths.path(99, block, substeps, False)[0].path for block in blocks])


def wide(rate, episodes=FEW):
    """Three standard deviations of a rate."""
    return 3.0 * np.sqrt(rate / episodes)


@pytest.mark.parametrize(
    ("s", "delta", "feedback"),
    [
        (Scenario.named("paper"), 0.01, False),
        (Scenario.random(6), 0.01, True),
        (Scenario.random(1), 0.002, True),
    ],
    ids=["paper", "random 6", "random 1"],
)
def test_the_sde_keeps_a_promise_on_the_path(s, delta, feedback):
    p = plan(s, risk=delta, risk_at="path", feedback=feedback, risk_episodes=FEW)
    assert (p.risk.at, p.options["risk_at"], p.options["integrator"]) == ("path", "path", "rk4")
    assert p.risk.substeps in (4, 8, 16, 32, 64)
    if p.risk.reached:
        assert p.status is Status.CONVERGED
        assert p.risk.verified <= delta
        assert chance(p, s) <= delta + wide(delta, 10_000)
    else:
        assert p.status is Status.RISK_UNREACHABLE
        assert chance(p, s) > delta - wide(delta, 10_000)
    assert p.risk.verified_at_nodes <= p.risk.verified


def test_the_evaluation_agrees(paper):
    p = plan(paper, risk=0.01, risk_at="path", risk_episodes=FEW)
    found = evaluate(OpenLoop(p), paper, 5_000, seed=3, substeps=32)
    assert abs(found.between_rate - p.risk.verified) < wide(0.01, 5_000) + wide(0.01)
    assert found.collision_rate < 0.7 * found.between_rate


def test_a_promise_at_nodes_is_not_one_on_the_path(paper):
    p = plan(paper, risk=0.01, risk_episodes=FEW)
    assert (p.risk.at, p.risk.substeps) == ("nodes", 1)
    assert p.options["risk_at"] == "nodes"
    assert chance(p, paper, substeps=16) > 0.02
    assert "at nodes" in str(p.risk)


def test_an_rk4_plan_is_promised_on_its_own_chain(paper):
    p = plan(paper, risk=0.01, integrator="rk4", risk_episodes=FEW)
    gains = np.zeros((*p.controls.shape, 5))
    chains = compiled(paper, Law(p.mean, p.controls, gains), "rk4")
    rate = 1.0 - np.mean([chains.chain(5, block) for block in range(10)])
    assert abs(rate - p.risk.verified) < wide(0.01) * 2.0
    assert p.risk.verified <= 0.01


def test_margins_between_nodes_are_in_the_plan(paper):
    """At the same price a plan on the path keeps farther off, and is safer there."""
    nodes = plan(paper, risk_price=30.0, integrator="rk4")
    path = plan(paper, risk_price=30.0, risk_at="path")
    assert nodes.status.ok
    assert path.status.ok
    assert chance(path, paper, substeps=8) < 0.9 * chance(nodes, paper, substeps=8)


def test_opaque_functions_are_promised_on_the_path_in_numpy(paper):
    """As `compiled=False`: the same paths, so the same plan but for rounding."""
    options = {"risk": 0.05, "risk_at": "path", "risk_episodes": 2048, "starts": 1}
    fast, slow = plan(paper, **options), plan(paper, compiled=False, **options)
    assert fast.risk.verified == pytest.approx(slow.risk.verified, abs=2e-3)
    assert fast.effort == pytest.approx(slow.effort, rel=5e-3)


def test_a_file_keeps_what_was_promised(paper, tmp_path):
    p = plan(paper, risk=0.05, risk_at="path", feedback=True, risk_episodes=2048)
    back = Plan.load(p.save(tmp_path / "plan.npz"))
    assert back.risk == p.risk
    assert "on the path" in str(back.risk)
    assert Feedback(back).closed_loop


def test_bad_input_is_named(paper):
    with pytest.raises(ValueError, match=r"risk_at.*'always'.*nodes.*path"):
        plan(paper, risk=0.01, risk_at="always")
    with pytest.raises(ValueError, match="give risk or risk_price"):
        plan(paper, risk_at="path")
