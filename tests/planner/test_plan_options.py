"""What `plan` promises of its options, and of problems whose numbers change between calls."""

import copy
import dataclasses
import functools
import pickle
import subprocess
import sys
import threading

import numpy as np
import pytest
import scipy.interpolate

from slipcar.envs import Scenario, car
from slipcar.planner import Status, plan, plan_batch
from slipcar.planner.trace import machine_code

GOAL = (2.2, 3.0, 0.0, 0.0, 0.0)
ALONG = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
wind = 0.0


class Hill:
    """A narrow hill on the way; of no effect where the guess rests."""

    control_weight = np.eye(1)

    def __init__(self, height=0.0, begin=0.0):
        self.height = height
        self.start, self.goal = np.zeros(2), np.array([1.5, 0.0])
        self.times = begin + np.linspace(0.0, 2.0, 21)

    def drift(self, t, x, u):
        slope = self.height * np.exp(-(((x[..., 0] - 1.2) / 0.1) ** 2))
        return np.stack([x[..., 1], u[..., 0] - slope], axis=-1)

    def diffusion(self, t, x):
        return np.zeros((*x.shape[:-1], 2, 1))

    def terminal(self, x):
        return x - self.goal


class Driven(Scenario):
    """A plain subclass: it takes attributes, though a Scenario is frozen."""

    def drift(self, t, x, u):
        return car.drift(x, u) + self.wind * ALONG

    def with_parameters(self, parameters):
        copied = super().with_parameters(parameters)
        copied.wind = self.wind
        return copied


@dataclasses.dataclass(frozen=True, eq=False)
class Blown(Scenario):
    """A number that it forgets to name among its parameters."""

    wind: float = 0.0

    def drift(self, t, x, u):
        return car.drift(x, u) + self.wind * ALONG


@dataclasses.dataclass(frozen=True, eq=False)
class Global(Scenario):
    def drift(self, t, x, u):
        return car.drift(x, u) + wind * ALONG


@dataclasses.dataclass(frozen=True, eq=False)
class OfItsClass(Scenario):
    def drift(self, t, x, u):
        return car.drift(x, u) + type(self).level() * ALONG

    @classmethod
    def level(cls):
        return cls.LEVEL


OfItsClass.LEVEL = 0.0


def _enclosed():
    level = 0.0

    @dataclasses.dataclass(frozen=True, eq=False)
    class Enclosed(Scenario):
        def drift(self, t, x, u):
            return car.drift(x, u) + level * ALONG

    def change(value):
        nonlocal level
        level = value

    return Enclosed, change


# ------------------------------------------------------------- numbers that change between calls


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("together", [False, True])
def test_a_change_that_cannot_be_seen_along_the_guess(compiled, together):
    def planned(problem):
        if together:
            return plan_batch([problem], compiled=compiled, tolerance=1e-9)[0]
        return plan(problem, compiled=compiled, tolerance=1e-9)

    problem = Hill()
    flat = planned(problem)
    problem.height = 5.0
    steep, fresh = planned(problem), planned(Hill(5.0))
    assert abs(flat.effort - fresh.effort) > 0.1
    np.testing.assert_allclose(steep.effort, fresh.effort, rtol=1e-9)
    assert steep.certificate.violations.dynamics < 1e-6


def test_arrays_changed_in_place():
    problem = Hill()
    plan(problem)
    problem.goal[0] = 1.0
    np.testing.assert_allclose(plan(problem).mean[-1], [1.0, 0.0], atol=1e-6)


def _same_as_new(kind, change):
    problem = kind(start=np.zeros(5), goal=GOAL)
    change(problem, 0.0)
    still = plan(problem)
    change(problem, 0.3)
    blown = plan(problem)
    new = kind(start=np.zeros(5), goal=GOAL)
    change(new, 0.3)
    assert abs(blown.effort - still.effort) > 0.1
    np.testing.assert_array_equal(blown.controls, plan(new).controls)
    np.testing.assert_array_equal(blown.controls, plan_batch([problem])[0].controls)


def test_attributes_of_a_plain_subclass():
    _same_as_new(Driven, lambda problem, value: setattr(problem, "wind", value))


def test_globals_that_a_frozen_problem_reads():
    def change(problem, value):
        global wind
        wind = value

    _same_as_new(Global, change)


def test_attributes_of_the_class_of_a_frozen_problem():
    _same_as_new(OfItsClass, lambda problem, value: setattr(OfItsClass, "LEVEL", value))


def test_variables_that_enclose_a_frozen_problem():
    kind, change = _enclosed()
    _same_as_new(kind, lambda problem, value: change(value))


def test_a_number_that_is_not_named_among_the_parameters():
    still = Blown(start=np.zeros(5), goal=GOAL)
    blown = dataclasses.replace(still, wind=0.3)
    alone = [plan(p).effort for p in (still, blown, still)]
    assert alone[0] == alone[2]
    assert abs(alone[0] - alone[1]) > 0.1
    assert [p.effort for p in plan_batch([still, blown, still])] == alone


def test_methods_that_are_replaced():
    problem = Hill()
    flat = plan(problem)
    drift = problem.drift
    problem.drift = lambda t, x, u: drift(t, x, u) - np.array([0.0, 0.5])
    blown = plan(problem)
    assert abs(blown.effort - flat.effort) > 0.1
    del problem.drift
    np.testing.assert_array_equal(plan(problem).controls, flat.controls)


class Partial(Hill):
    """Its functions are partials and callable objects, as those of a factory would be."""

    def __init__(self, slope):
        super().__init__()
        self.slope = slope
        self.drift = functools.partial(Partial.moved, self)
        self.terminal = Partial.Goal(self.goal)

    def moved(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - self.slope * x[..., 0]], axis=-1)

    class Goal:
        def __init__(self, goal):
            self.goal = goal

        def __call__(self, x):
            return x - self.goal


def test_partials_and_callable_objects():
    problem = Partial(0.0)
    plan(problem)
    problem.slope, problem.terminal.goal = 2.0, np.array([0.5, 0.0])
    changed = plan(problem, tolerance=1e-9)
    np.testing.assert_allclose(changed.mean[-1], [0.5, 0.0], atol=1e-9)
    fresh = Partial(2.0)
    fresh.terminal.goal = np.array([0.5, 0.0])
    np.testing.assert_array_equal(changed.controls, plan(fresh, tolerance=1e-9).controls)


def test_a_drift_at_random_is_refused():
    class Random(Hill):
        def drift(self, t, x, u):
            return super().drift(t, x, u) + np.random.default_rng().normal()

    with pytest.raises(ValueError, match="affine"):
        plan(Random())


# ------------------------------------------------------------------------------ unreachable ends


@pytest.mark.parametrize("compiled", [None, False])
def test_an_end_out_of_reach_is_told(compiled):
    scenario = Scenario.named("open").replace(control_bounds=(0.1, 0.1), nodes=11)
    p = plan(scenario, compiled=compiled)
    assert p.status is Status.INFEASIBLE
    assert "g[1]" in p.message


@pytest.mark.parametrize("starts", [1, 3])
def test_an_end_far_out_of_reach_is_named_whatever_the_status(paper, starts):
    p = plan(paper.replace(goal=(30.0, 0.0, 0.0, 0.0, 0.0), nodes=11), starts=starts)
    assert not p.status.ok
    assert "g[0] = -" in p.message
    assert p.iterations <= 200


def test_what_is_lacking_when_iterations_run_out(paper):
    for n in (1, 3):
        p = plan(paper, max_iterations=n)
        assert (p.status, p.iterations) == (Status.MAX_ITERATIONS, n)
        assert p.message


def test_no_horizon_gives_a_plan(paper):
    p = plan(paper, free_final_time=True, max_iterations=1)
    assert p.status is Status.MAX_ITERATIONS
    assert "none of the horizons tried" in p.message


# ------------------------------------------------------------------------------------- callbacks

RUNS = {
    "newton": {},
    "convex": {"method": "convex"},
    "osqp": {"solver": "osqp"},  # leaves penalties out first, too
    "shooting": {"shooting": True},
}


@pytest.mark.parametrize("options", RUNS.values(), ids=RUNS)
def test_callbacks_see_every_iteration(paper, options):
    seen = []
    p = plan(paper, callback=seen.append, **options)
    assert p.status.ok
    assert len(seen) == p.iterations == len(p.history)


@pytest.mark.parametrize(
    "options", [*RUNS.values(), {"free_final_time": True}], ids=[*RUNS, "free final time"]
)
@pytest.mark.parametrize("after", [1, 2])
def test_callbacks_stop(paper, options, after):
    seen = []

    def stop(iteration):
        seen.append(iteration)
        return len(seen) >= after

    p = plan(paper, callback=stop, **options)
    assert p.status is Status.STOPPED
    assert len(seen) == after
    assert p.cost == pytest.approx(p.effort + p.obstacle_cost)
    c = np.maximum(paper.penalty(p.times[1:], p.mean[1:]), 0.0)
    dt = np.diff(p.times)
    assert p.obstacle_cost == pytest.approx(float(dt @ (c**2 @ paper.penalty_weight)))


def test_stopping_a_search_of_the_final_time_keeps_the_best_plan(paper):
    first = len(plan(paper).history)
    seen = []

    def stop(iteration):
        seen.append(iteration)
        return len(seen) > first + 8  # some horizons later

    p = plan(paper, free_final_time=True, callback=stop)
    assert p.status is Status.STOPPED
    assert first + 9 <= len(seen) <= first + 10  # one more where that one converged
    assert p.times[-1] == p.problem.times[-1]
    np.testing.assert_allclose(p.mean[-1], paper.goal, atol=1e-6)


@pytest.mark.parametrize("options", [*RUNS.values(), {"starts": 3}, {"free_final_time": True}])
def test_errors_of_callbacks_come_through(paper, options):
    def fail(iteration):
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        plan(paper, callback=fail, **options)


# ------------------------------------------------------------------------ options that conflict


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "newton", "solver": "osqp"}, "method='newton' cannot be combined with solver"),
        ({"method": "newton", "trust_region": "adaptive"}, "cannot be combined with trust_region"),
        ({"compiled": True, "method": "convex"}, "compiled=True .* method='convex'"),
        ({"compiled": True, "solver": "osqp"}, "compiled=True .* solver='osqp'"),
        ({"compiled": True, "terminal_tolerance": 1e-3}, "compiled=True .* terminal_tolerance"),
        ({"compiled": True, "shooting": True}, "shooting=True .* compiled=True"),
        ({"callback": 3}, "callback must be a function"),
        ({"solver": 3}, "solver must be a name or an object"),
        ({"solver": None}, "solver must be a name or an object"),
        ({"free_first": "no"}, "free_first must be"),
        ({"free_first": np.ones(2)}, "free_first must be"),
        ({"shooting": "yes"}, "shooting must be"),
        ({"free_final_time": 2}, "free_final_time must be"),
        ({"check_derivatives": []}, "check_derivatives must be"),
    ],
)
def test_conflicts_are_told(paper, options, message):
    with pytest.raises(ValueError, match=message):
        plan(paper, **options)


@pytest.mark.skipif(not machine_code.available(), reason="needs llvmlite")
def test_compiled_or_not_the_plan_is_the_same(paper):
    seen = []
    default, native, plain = (
        plan(paper, compiled=compiled, callback=seen.append, tolerance=1e-9)
        for compiled in (None, True, False)
    )
    np.testing.assert_array_equal(default.controls, native.controls)
    np.testing.assert_allclose(native.controls, plain.controls, atol=1e-9)
    assert native.iterations == plain.iterations
    assert len(seen) == 3 * plain.iterations


class Tabled(Hill):
    """With a spline of SciPy's, which cannot be traced."""

    road = scipy.interpolate.CubicSpline([-9.0, 0.0, 1.0, 9.0], [0.0, 0.2, -0.1, 0.0])

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - self.road(x[..., 0])], axis=-1)


@pytest.mark.skipif(not machine_code.available(), reason="needs llvmlite")
def test_what_cannot_be_traced_says_why(rollout):
    with pytest.raises(ValueError, match=r"functions of Tabled cannot be compiled: drift.*road"):
        plan(Tabled(), compiled=True)
    for compiled in (None, False):
        p = plan(Tabled(), compiled=compiled, tolerance=1e-9)
        assert p.status is Status.CONVERGED
        assert "differentiated numerically, as they cannot be traced: drift" in p.message
        np.testing.assert_allclose(p.mean, rollout(p.problem, p.controls), atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"compiled": False}, {"method": "convex"}])
def test_a_branch_is_refused_with_its_line_and_what_to_write_instead(options):
    class Branching(Hill):
        def drift(self, t, x, u):
            if (x[..., 0] > 9.0).any():
                return 0.0 * x
            return super().drift(t, x, u)

    with pytest.raises(ValueError, match=r"drift: a branch.*np\.where.*test_plan_options\.py:\d+"):
        plan(Branching(), **options)


def test_without_llvmlite_plans_are_made_by_numpy_and_it_is_said():
    code = """
import sys
sys.modules["llvmlite"] = None
from slipcar.envs import Scenario
from slipcar.planner import plan, plan_batch
paper = Scenario.named("open").replace(nodes=11)
assert plan(paper).status.ok and plan_batch([paper])[0].status.ok
for call in (lambda: plan(paper, compiled=True), lambda: plan_batch([paper], compiled=True)):
    try:
        call()
    except ImportError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["compiled=True needs llvmlite: pip install llvmlite"] * 2
    assert done.stderr.count("llvmlite is missing") == 1


# --------------------------------------------------------------------- time grids, units, copies


def test_the_origin_of_time_does_not_matter():
    options = {"free_final_time": True, "time_weight": 3.0}
    now, later = plan(Hill(), **options), plan(Hill(begin=100.0), **options)
    assert now.status.ok
    assert later.status.ok
    assert later.final_time - 100.0 == pytest.approx(now.final_time, rel=1e-9)


@pytest.mark.parametrize("begin", [0.0, 100.0, -7.0])
def test_a_final_time_at_its_bound_says_so(begin):
    p = plan(Hill(begin=begin), free_final_time=True, final_time_bounds=(0.31, 0.73))
    assert p.status.ok
    assert p.final_time - begin == pytest.approx(0.73)
    assert "at its bound" in p.message


@pytest.mark.parametrize("scale", [1e-3, 1e3, 1e6])
def test_units_of_the_cost_do_not_matter(scale):
    class Priced(Hill):
        control_weight = scale * np.eye(1)

    p, q = plan(Priced(1.0), tolerance=1e-9), plan(Hill(1.0), tolerance=1e-9)
    assert p.status.ok
    np.testing.assert_allclose(p.controls, q.controls, atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"method": "convex"}, {"compiled": False}])
def test_no_terminal_condition_no_noise_one_state(options):
    class Free:
        start, times, control_weight = np.ones(1), np.linspace(0.0, 1.0, 6), np.eye(1)

        def drift(self, t, x, u):
            return u

        def diffusion(self, t, x):
            return np.zeros((*x.shape, 0))

        def terminal(self, x):
            return x[..., :0]

    p = plan(Free(), **options)
    assert p.status.ok
    np.testing.assert_allclose(p.controls, 0.0, atol=1e-12)
    assert p.certificate.extremal


@pytest.mark.parametrize("how", [copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
@pytest.mark.parametrize(
    "options", [{}, {"free_final_time": True}, {"starts": 3}, {"shooting": True}]
)
def test_copies_of_plans_are_plans(options, how):
    p = plan(Scenario.named("paper"), **options)
    q = how(p)
    np.testing.assert_array_equal(q.controls, p.controls)
    assert repr(q) == repr(p)
    assert len(q.history) == len(p.history)
    assert q.certificate.extremal
    np.testing.assert_array_equal(plan(q.problem).controls, plan(p.problem).controls)


def test_several_threads_plan_at_once():
    heights = [0.2 * i for i in range(8)]
    wanted = [plan(Hill(h)).controls for h in heights]
    wrong = []

    def work():
        for height, controls in zip(heights, wanted, strict=True):
            if not np.array_equal(plan(Hill(height)).controls, controls):
                wrong.append(height)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
