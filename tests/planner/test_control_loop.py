"""`RecedingHorizon.step`: one episode in a control loop, with a deadline and without."""

import pickle
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import RecedingHorizon
from slipcar.planner.control_loop import ControlLoop

PAPER = Scenario.named("paper")


@pytest.fixture
def controller():
    return RecedingHorizon(PAPER)


def busy(controller):
    """The same with replans that take a while."""
    renewed = controller._renewed

    def slowly(*arguments):
        time.sleep(0.2)
        return renewed(*arguments)

    controller._renewed = slowly
    return controller


def states(controller, seed=0):
    """The plan's states, somewhat off."""
    noise = 0.01 * np.random.default_rng(seed).standard_normal(controller.plan.mean.shape)
    noise[0] = 0.0
    return controller.plan.mean + noise


def test_steps_are_what_predict_answers(controller):
    other, memory = RecedingHorizon(PAPER), None
    for t, x in zip(PAPER.times[:-1], states(controller), strict=False):
        u = controller.step(x, t)
        action, memory = other.predict(np.append(x, t), memory)
        np.testing.assert_allclose(u / PAPER.action_scale, action, atol=1e-6)
    assert (controller.replans, controller.late) == (other.replans, 0)


def test_a_generous_deadline_changes_nothing(controller):
    other = RecedingHorizon(PAPER)
    for t, x in zip(PAPER.times[:-1], states(controller), strict=False):
        np.testing.assert_array_equal(controller.step(x, t, deadline=30.0), other.step(x, t))
    assert controller.late == 0


def test_a_deadline_that_cannot_be_kept_plays_the_feedback_law(controller):
    x = states(controller)[1]
    u = busy(controller).step(x, PAPER.times[1], deadline=1e-3)
    p = controller.plan
    law = p.controls[1] + p.gains[1] @ (x - p.mean[1])
    np.testing.assert_allclose(u, np.clip(law, -PAPER.control_bounds, PAPER.control_bounds))
    assert controller.late == 1


def test_headings_are_known_modulo_a_turn(controller):
    x = states(controller)[1]
    turned = x + 2 * np.pi * np.eye(5)[2]
    for deadline in (None, 1e-3):
        one, two = (busy(RecedingHorizon(PAPER)) for _ in range(2))
        a = one.step(x, PAPER.times[1], deadline=deadline)
        np.testing.assert_allclose(two.step(turned, PAPER.times[1], deadline=deadline), a)


def test_a_time_that_goes_back_begins_anew(controller):
    x = states(controller)
    first = [controller.step(x[k], PAPER.times[k]) for k in range(5)]
    again = [controller.step(x[k], PAPER.times[k]) for k in range(5)]
    np.testing.assert_array_equal(first, again)


def test_what_is_underway_can_be_previewed(controller):
    assert controller.underway is None
    controller.step(states(controller)[3], PAPER.times[3])
    mean, covariance = controller.preview(controller.underway)
    assert mean.shape == (PAPER.nodes - 3, 5)
    assert covariance.shape == (PAPER.nodes - 3, 5, 5)


def test_another_process_begins_an_episode_of_its_own(controller):
    x = states(controller)[1]
    u = controller.step(x, PAPER.times[1], deadline=10.0)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(controller)).step(x, PAPER.times[1]), u)


@pytest.mark.parametrize(
    ("x", "t", "deadline", "words"),
    [
        (np.zeros(4), 0.0, None, "x must be 5 finite numbers"),
        ([np.nan] * 5, 0.0, None, "x must be 5 finite numbers"),
        (np.zeros((1, 5)), 0.0, None, "x must be 5 finite numbers"),
        (np.zeros(5), np.inf, None, "t must be finite"),
        (np.zeros(5), 0.0, 0.0, "deadline must be finite and > 0"),
        (np.zeros(5), 0.0, -1, "deadline must be finite and > 0"),
        (np.zeros(5), 0.0, "soon", "deadline must be finite and > 0"),
    ],
)
def test_bad_input_is_named(controller, x, t, deadline, words):
    with pytest.raises(ValueError, match=words):
        controller.step(x, t, deadline=deadline)


# --- the loop alone, with a solver that is as slow as it is told to be ----------------------


@pytest.fixture
def slow():
    """A loop whose state counts the renewals, and the gate that they wait for."""
    gate, asked = threading.Event(), []

    def renew(state, x, interval):
        asked.append(interval)
        gate.wait(30.0)
        return np.array([100.0 + interval]), state + 1

    loop = ControlLoop(lambda state, x, interval: np.array([float(state)]), renew, 0)
    yield SimpleNamespace(loop=loop, gate=gate, asked=asked)
    gate.set()


def settled(loop):
    while not loop._asked.done():
        time.sleep(1e-3)


def test_the_last_good_law_goes_on_while_the_solver_is_busy(slow):
    for k in range(4):
        assert slow.loop.step(np.zeros(1), k, 1e-3) == [0.0]
    assert slow.loop.late == 4
    assert slow.asked == [0]  # one request at a time


def test_turns_of_threads_are_as_before_afterwards(slow):
    before = sys.getswitchinterval()
    slow.loop.step(np.zeros(1), 0, 1e-3)
    assert sys.getswitchinterval() == before


def test_a_late_answer_serves_the_steps_to_come(slow):
    assert slow.loop.step(np.zeros(1), 0, 1e-3) == [0.0]
    slow.gate.set()
    settled(slow.loop)
    assert slow.loop.step(np.zeros(1), 1, 30.0) == [101.0]
    assert slow.loop.state == 2
    assert slow.loop.late == 1


def test_a_new_episode_takes_nothing_over(slow):
    slow.gate.set()
    slow.loop.step(np.zeros(1), 7, 30.0)
    assert slow.loop.state == 1
    slow.gate.clear()
    assert slow.loop.step(np.zeros(1), 0, 1e-3) == [0.0]


def test_a_solver_that_fails_is_heard():
    def renew(state, x, interval):
        raise ZeroDivisionError("no plan")

    loop = ControlLoop(lambda state, x, interval: x, renew, 0)
    with pytest.raises(ZeroDivisionError, match="no plan"):
        loop.step(np.zeros(1), 0, 30.0)
