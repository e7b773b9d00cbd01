"""What the method assumes is checked: noise-free diffusion, affine controls, right Jacobians."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.problem.checks import check_assumptions, check_derivatives
from slipcar.planner.problem.model import model_of


class Cart:
    """A double integrator; members given to it replace its own."""

    start = np.zeros(2)
    times = np.linspace(0.0, 2.0, 21)
    control_weight = np.eye(1)

    def __init__(self, **members):
        self.__dict__.update(members)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 2, 1), 0.1)

    def terminal(self, x):
        return x - np.array([1.0, 0.0])


def refused(message, problem, **options):
    with pytest.raises(ValueError, match=message):
        plan(problem, **options)


def noise(*rows):
    """A diffusion (t, x) -> (..., n, d) from functions of x, row by row."""

    def diffusion(t, x):
        return np.stack(
            [np.stack([entry(x) + 0.0 * x[..., 0] for entry in row], -1) for row in rows], -2
        )

    return diffusion


class Chain(Cart):
    """x0' = x1, x1' = x2, x2' = u: noise moves up the chain, never down."""

    start = np.array([0.2, 0.1, 0.3])

    def drift(self, t, x, u):
        return np.stack([x[..., 1], x[..., 2], u[..., 0]], axis=-1)

    def terminal(self, x):
        return x[..., :2]


ZERO, TENTH = (lambda x: 0.0), (lambda x: 0.1)


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        # The state that is driven is the one σ depends on.
        (
            Cart(diffusion=noise([ZERO], [lambda x: 0.1 + x[..., 1]])),
            r"diffusion\[1, 0\] depends on x\[1\].*noise → x\[1\]\).*expected=True",
        ),
        # It is reached through the drift: noise on the speed moves the position.
        (
            Cart(diffusion=noise([ZERO], [lambda x: np.sin(x[..., 0])])),
            r"diffusion\[1, 0\] depends on x\[0\].*noise → x\[1\] → x\[0\]",
        ),
        # Along two links.
        (
            Chain(diffusion=noise([lambda x: x[..., 0]], [ZERO], [TENTH])),
            r"depends on x\[0\].*noise → x\[0\]",
        ),
        (
            Chain(diffusion=noise([ZERO, ZERO], [ZERO, ZERO], [TENTH, lambda x: x[..., 0] ** 2])),
            r"diffusion\[2, 1\] depends on x\[0\].*noise → x\[2\] → x\[1\] → x\[0\]",
        ),
        # The car that slips, were its heading to matter: v ω (1 + θ).
        (
            Cart(
                start=np.full(3, 0.3),
                drift=lambda t, x, u: np.stack([x[..., 1], u[..., 0], x[..., 1]], -1),
                terminal=lambda x: x[..., :2],
                diffusion=noise([lambda x: x[..., 1] * (1 + x[..., 2])], [ZERO], [TENTH]),
            ),
            r"diffusion\[0, 0\] depends on x\[2\]",
        ),
    ],
)
def test_a_diffusion_of_noisy_states_is_refused_with_the_path_of_the_noise(problem, message):
    refused(message, problem)
    refused(message, problem, variance_weight=0.1)
    assert plan(problem, variance_weight=0.0).status is Status.CONVERGED


@pytest.mark.parametrize(
    "problem",
    [
        Cart(),
        Cart(diffusion=noise([lambda x: x[..., 1]], [ZERO])),
        Chain(diffusion=noise([lambda x: x[..., 1] * x[..., 2]], [ZERO], [ZERO])),
        Chain(diffusion=noise([lambda x: 1.0 + x[..., 2]], [lambda x: x[..., 2]], [ZERO])),
        Chain(diffusion=noise([ZERO], [ZERO], [ZERO])),
        Chain(diffusion=lambda t, x: np.ones((*x.shape[:-1], 3, 1)) * np.sin(t)[..., None, None]),
    ],
)
def test_a_diffusion_of_noise_free_states_and_time_is_not(problem):
    assert not check_assumptions(model_of(problem), *model_of(problem).guess())
    assert plan(problem).status is Status.CONVERGED


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_the_verdict_does_not_depend_on_units(scale):
    good = Cart(diffusion=noise([lambda x: scale * x[..., 1]], [ZERO]))
    bad = Cart(diffusion=noise([lambda x: scale * x[..., 0]], [ZERO]))
    assert not check_assumptions(model_of(good), *model_of(good).guess())
    assert "depends on x[0]" in check_assumptions(model_of(bad), *model_of(bad).guess())


@pytest.mark.parametrize("name", Scenario.names())
def test_the_car_that_slips_is_accepted(name):
    scenario = Scenario.named(name)
    model = model_of(scenario)
    x, u = model.guess()
    noisy = (np.asarray(model.diffusion(model.times, x)) != 0.0).any(axis=(0, 2))
    uncertain = noisy | model.start_covariance.any(axis=1)
    assert bool(check_assumptions(model, x, u)) == uncertain[3:].any()  # what slip depends on
    check_derivatives(model, *model.guess())


@pytest.mark.parametrize(
    "drift",
    [
        lambda t, x, u: np.stack([x[..., 1], u[..., 0] ** 2], -1),
        lambda t, x, u: np.stack([x[..., 1], u[..., 0] + 1e-3 * u[..., 0] ** 3], -1),
        lambda t, x, u: np.stack([x[..., 1], np.sin(u[..., 0])], -1),
        lambda t, x, u: np.stack([x[..., 1], u[..., 0] * (1.0 + x[..., 1] * u[..., 0])], -1),
    ],
)
def test_a_drift_that_bends_with_the_control_is_refused(drift):
    refused(r"drift must be affine in the control.*component 1 is not", Cart(drift=drift))


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e6, 1e9])
def test_a_drift_that_bends_is_refused_in_any_unit_of_the_control(unit):
    """Controls of order `unit`; a step of one is nothing beside them, or far beyond them."""

    def drift(t, x, u):
        v = u[..., 0] / unit
        return np.stack([x[..., 1], v + 0.1 * v**2], -1)

    refused(
        r"drift must be affine in the control.*component 1 is not",
        Cart(drift=drift, control_weight=np.eye(1) / unit**2),
    )


def test_a_drift_that_is_affine_within_the_bounds_is_taken():
    """What saturates at the bounds bends beyond them alone."""

    def drift(t, x, u):
        return np.stack([x[..., 1], np.clip(u[..., 0], -4.0, 4.0)], -1)

    assert plan(Cart(drift=drift, control_bounds=np.array([4.0]))).status is Status.CONVERGED


def test_a_product_of_two_controls_is_not_affine():
    def drift(t, x, u):
        return np.stack([u[..., 0] * u[..., 1], u[..., 0]], -1)

    refused("component 0 is not", Cart(drift=drift, control_weight=np.eye(2)))


def test_controls_times_functions_of_state_and_time_are_affine():
    def drift(t, x, u):
        return np.stack([x[..., 1], 1.0 + np.exp(x[..., 0]) * (2.0 + np.sin(t)) * u[..., 0]], -1)

    assert plan(Cart(drift=drift), variance_weight=0.0).status is Status.CONVERGED


class Spring(Cart):
    """With every function a problem may have, all analytic."""

    penalty_weight = np.array([2.0])

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0])], axis=-1)

    def penalty(self, t, x):
        return x[..., 1:] ** 2 - 0.3

    def state_cost(self, t, x):
        return x[..., 0] ** 4

    def control_cost(self, t, x):
        return np.cos(x[..., 1:])


@pytest.mark.parametrize(
    "members",
    [
        {},
        # What the complex step took for something else, tracing does not.
        {"state_cost": lambda t, x: (x[..., 0] * np.conj(x[..., 0])).real},
        {"penalty": lambda t, x: x[..., :1] * np.abs(x[..., :1] + 0.3)},
        {"terminal": lambda x: np.stack([np.conj(x[..., 0]) - 0.5, np.real(x[..., 1])], -1)},
        {"control_cost": lambda t, x: np.linalg.norm(x, axis=-1, keepdims=True) * x[..., :1]},
    ],
)
def test_right_derivatives_pass(members):
    assert plan(Spring(**members), check_derivatives=True).status is Status.CONVERGED


def test_a_kink_at_the_guess_is_named_as_what_it_may_be():
    # Resting at the start, among the points that are looked at, where differences give ½.
    kink = Cart(state_cost=lambda t, x: np.maximum(x[..., 0], 0.0))
    refused(
        r"state_cost_derivatives\[0\]\[0\] \(traced\) is 0 .* give 0.5; is the function smooth",
        kink, check_derivatives=True,
    )  # fmt: skip


def wrong(shape, entry, value):
    def jacobian(*arguments):
        out = np.zeros((*arguments[-1].shape[:-1], *shape))
        out[(..., *entry)] = value
        return out

    return jacobian


def drift_jacobian(t, x, u):
    A, B = np.zeros((*x.shape, 2)), np.zeros((*x.shape, 1))
    A[..., 0, 1] = 1.0
    A[..., 1, 0] = np.cos(x[..., 0])  # the sign is wrong
    B[..., 1, 0] = 1.0
    return A, B


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (
            {"drift_jacobian": drift_jacobian},
            r"drift_jacobian\[0\]\[1, 0\] \(your function\) is .* but differences give -",
        ),
        (
            {"diffusion_jacobian": wrong((2, 1, 2), (0, 0, 1), 1.0)},
            r"diffusion_jacobian\[0, 0, 1\] \(your function\) is 1 .* give 0",
        ),
        ({"penalty_jacobian": wrong((1, 2), (0, 0), 1.0)}, r"penalty_jacobian\[0, 0\]"),
        ({"terminal_jacobian": wrong((2, 2), (0, 0), 1.0)}, r"terminal_jacobian\[1, 1\] .* is 0 "),
        (
            {"state_cost_derivatives": lambda t, x: (4.0 * x**3, np.zeros((*x.shape, 2)))},
            r"state_cost_derivatives\[0\]\[1\]",
        ),
        ({"control_cost_jacobian": wrong((1, 2), (0, 0), 0.5)}, r"control_cost_jacobian\[0, 0\]"),
    ],
)  # fmt: skip
def test_wrong_derivatives_are_named_on_request(members, message):
    refused(message, Spring(**members), check_derivatives=True)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (
            {"drift": lambda t, x, u: np.zeros((2, 2)) + u[:2]},
            r"drift.*must have shape \(2,\) for one point, not \(2, 2\)",
        ),
        ({"terminal": lambda x: np.zeros((2, 1))}, r"terminal\(x\) must have shape|\(16, 1\)"),
        (
            {"penalty": lambda t, x: np.zeros((2, 1)), "penalty_weight": np.ones(1)},
            r"penalty\(t, x\) must have shape \(16, \w+\) for 16 points, not \(2, 1\)",
        ),
        (
            {
                "diffusion": lambda t, x: np.full((len(x), 2, min(len(x), 3)), 0.1),
                "diffusion_jacobian": lambda t, x: np.zeros((len(x), 2, 2, 2)),
            },
            r"diffusion_jacobian\(t, x\) must have shape \(16, 2, 3, 2\)",
        ),
    ],
)
def test_shapes_that_change_with_the_batch(members, message):
    with pytest.raises(ValueError, match=message):
        plan(Cart(**members))


def test_what_one_problem_passed_is_not_taken_for_granted_of_another():
    # Traced they are the same; only the first answers as it should.
    assert plan(Cart()).status is Status.CONVERGED
    short = Cart(diffusion_jacobian=lambda t, x: np.zeros((2, 2, 1, 2)))
    refused(r"diffusion_jacobian\(t, x\) must have shape \(16, 2, 1, 2\)", short)


def test_points_where_the_drift_is_undefined_are_no_reason_to_refuse():
    # √x has no value left of zero, where a random point may fall.
    def drift(t, x, u):
        with np.errstate(invalid="ignore"):
            return np.stack([x[..., 1], u[..., 0] + np.sqrt(x[..., 0] + 0.02)], axis=-1)

    # √ is not smooth at the start's left; the plan moves right.
    assert plan(Cart(drift=drift), variance_weight=0.0).status is Status.CONVERGED


def test_what_is_out_of_reach_is_named():
    p = plan(Cart(control_bounds=np.array([0.9])), variance_weight=0.0)
    assert p.status is Status.INFEASIBLE
    assert "out of reach" in p.message
    for j, value in enumerate(p.problem.terminal(p.mean[-1])):
        assert (f"g[{j}] = {value:.4g}" in p.message) == (abs(value) > 1e-5)
    both = Cart(terminal=lambda x: np.stack([x[..., 0] - 1.0, x[..., 0] - 3.0, x[..., 1]], -1))
    q = plan(both, variance_weight=0.0)
    assert q.status is Status.INFEASIBLE
    assert "g[2]" not in q.message  # the speed is no trouble
    assert "g[0]" in q.message or "g[1]" in q.message


def test_functions_that_are_not_finite_along_the_guess_are_named():
    x = np.linspace([0.0, 0.0], [3.0, 0.0], 21)
    log = Cart(penalty=lambda t, x: np.log(2.0 - x[..., :1]), penalty_weight=np.ones(1))
    with np.errstate(all="ignore"):
        refused("penalty is not finite along the guess", log, guess=(x, np.zeros((20, 1))))


# ------------------------------------------------------------------------- what is remembered


class Counted(Cart):
    """Counts how often its functions are called at the start, two points at once."""

    calls = 0

    def terminal(self, x):
        if x.dtype != object and len(x) == 2 and not x.any():
            self.calls += 1
        return super().terminal(x)


def test_a_problem_is_looked_at_once_while_its_numbers_stay():
    problem = Counted()
    for _ in range(3):
        model_of(problem)
    assert problem.calls == 1
    model_of(Counted())  # equal, but another object
    assert problem.calls == 1
    problem.start = np.zeros(2)  # the same numbers
    model_of(problem)
    assert problem.calls == 1
    problem.times = np.linspace(0.0, 3.0, 31)
    assert model_of(problem).times[-1] == 3.0
    assert problem.calls == 2


@pytest.mark.parametrize(
    ("name", "value", "read"),
    [
        ("start", np.array([0.5, 0.0]), lambda m: m.start),
        ("times", np.linspace(1.0, 2.0, 5), lambda m: m.times),
        ("control_weight", np.array([[3.0]]), lambda m: m.R),
        ("control_bounds", np.array([2.5]), lambda m: m.upper),
        ("start_covariance", 0.1 * np.eye(2), lambda m: m.start_covariance),
        ("penalty_weight", np.array([7.0]), lambda m: m.weight),
        ("control_radius", 2.0, lambda m: m.radius),
    ],
)
def test_numbers_that_change_are_seen_also_in_place(name, value, read):
    cart = Cart(penalty=lambda t, x: x[..., :1], penalty_weight=np.ones(1))
    model_of(cart)
    setattr(cart, name, value)
    np.testing.assert_array_equal(read(model_of(cart)), value)
    if isinstance(value, np.ndarray):
        value[0] = 0.25 * value[0]
        np.testing.assert_array_equal(read(model_of(cart)), value)


def test_functions_are_never_remembered():
    cart = Cart()
    assert plan(cart).status is Status.CONVERGED
    before = model_of(cart)
    slope = before.drift_jacobian(np.zeros(1), np.ones((1, 2)), np.ones((1, 1)))[0][0, 1, 0]
    cart.drift = lambda t, x, u: np.stack([x[..., 1], u[..., 0] - 3.0 * x[..., 0]], -1)
    after = model_of(cart).drift_jacobian(np.zeros(1), np.ones((1, 2)), np.ones((1, 1)))[0]
    assert (slope, after[0, 1, 0]) == (0.0, -3.0)
    cart.drift = lambda t, x, u: np.stack([x[..., 1], u[..., 0] ** 2], -1)
    refused("affine", cart)


def test_functions_that_come_and_go_are_seen():
    cart = Cart()
    free = plan(cart, variance_weight=0.0, tolerance=1e-9)
    cart.state_cost = lambda t, x: 9.0 * x[..., 1] ** 2
    slow = plan(cart, variance_weight=0.0, tolerance=1e-9)
    assert slow.running_cost == pytest.approx(0.1 * np.sum(9.0 * slow.mean[1:, 1] ** 2))
    assert np.abs(slow.mean[:, 1]).max() < 0.95 * np.abs(free.mean[:, 1]).max()
    del cart.state_cost
    again = plan(cart, variance_weight=0.0, tolerance=1e-9)
    np.testing.assert_array_equal(again.controls, free.controls)


def test_a_model_made_before_keeps_its_numbers():
    cart = Cart()
    model = model_of(cart)
    cart.start = np.array([0.5, 0.0])
    assert model_of(cart).start[0] == 0.5
    np.testing.assert_array_equal(model.start, np.zeros(2))


@dataclasses.dataclass(frozen=True)
class Slotted:
    """No weak reference can be made to it."""

    __slots__ = ("target",)
    target: float

    start = property(lambda self: np.zeros(2))
    times = property(lambda self: np.linspace(0.0, 2.0, 21))
    control_weight = property(lambda self: np.eye(1))
    drift = Cart.drift
    diffusion = Cart.diffusion

    def terminal(self, x):
        return x - np.array([self.target, 0.0])


def test_problems_that_cannot_be_remembered_are_planned_all_the_same():
    for target in (1.0, 0.5):
        p = plan(Slotted(target))
        np.testing.assert_allclose(p.mean[-1], [target, 0.0], atol=1e-6)


def test_many_problems_at_once_are_not_confused():
    problems = [Cart(start=np.array([0.01 * i, 0.0])) for i in range(300)]
    for _ in range(2):
        for i, problem in enumerate(problems):
            assert model_of(problem).start[0] == 0.01 * i
            assert model_of(problem).problem is problem


@pytest.mark.parametrize("options", [{}, {"method": "convex"}, {"expected": True}])
@pytest.mark.parametrize(
    "make", [Cart, lambda: Scenario.named("open").replace(nodes=11)], ids=["cart", "scenario"]
)
def test_forgotten_problems_are_freed(make, options):
    problem = make()
    gone = weakref.ref(problem)
    plan(problem, **options)
    del problem
    gc.collect()
    assert gone() is None
