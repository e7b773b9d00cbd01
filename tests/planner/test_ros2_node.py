"""The ROS 2 example without ROS: what its pilot decides, and how the node is wired."""

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from slipcar.envs import Scenario

FILE = Path(__file__).parents[2] / "examples" / "ros2_node.py"
PAPER = Scenario.named("paper")


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("example_ros2_node", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def pilot(example):
    return example.Pilot(PAPER)


def observe(pilot, now, x):
    pilot.observe(now, x[0], x[1], math.sin(x[2] / 2), math.cos(x[2] / 2), x[3], x[4])


def test_it_stands_still_until_it_knows_where_it_is(pilot):
    assert pilot.command(100.0) == (0.0, 0.0)
    observe(pilot, 100.1, PAPER.start)
    assert pilot.command(100.1)[0] > 0.0


def test_it_stops_when_odometry_stops(pilot, example):
    observe(pilot, 100.0, PAPER.start)
    assert pilot.command(100.0)[0] > 0.0
    assert pilot.command(100.0 + 0.9 * example.STALE) != (0.0, 0.0)
    assert pilot.command(100.0 + 1.1 * example.STALE) == (0.0, 0.0)


def test_a_bad_message_is_as_none(pilot):
    observe(pilot, 100.0, PAPER.start)
    observe(pilot, 100.4, np.full(5, np.nan))
    assert pilot.command(100.45) != (0.0, 0.0)
    assert pilot.command(100.6) == (0.0, 0.0)


def test_it_arrives_and_stops_at_the_end(pilot):
    x, rng = PAPER.start, np.random.default_rng(5)
    for t in PAPER.times[:-1]:
        observe(pilot, 7.0 + t, x)
        u = (np.array(pilot.command(7.0 + t)) - x[3:]) / PAPER.dt
        assert (np.abs(u) <= PAPER.control_bounds + 1e-9).all()
        noise = PAPER.diffusion(t, x) @ rng.standard_normal(3) * math.sqrt(PAPER.dt)
        x = x + PAPER.dt * PAPER.drift(t, x, u) + noise
    assert np.hypot(*(x - PAPER.goal)[:2]) < 0.3
    observe(pilot, 12.0, x)
    assert pilot.command(12.0) == (0.0, 0.0)


def test_the_node_hears_odometry_and_writes_speeds(example, pilot, monkeypatch):
    """ROS's names, of our own making: messages in, messages out."""
    written, hooks = [], {}

    class Twist:
        def __init__(self):
            self.linear, self.angular = SimpleNamespace(x=0.0), SimpleNamespace(z=0.0)

    publisher = SimpleNamespace(publish=lambda m: written.append((m.linear.x, m.angular.z)))
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=3_000_000_000))
    node = SimpleNamespace(
        create_publisher=lambda kind, topic, depth: publisher,
        create_subscription=lambda kind, topic, heard, depth: hooks.update(heard=heard),
        create_timer=lambda period, tick: hooks.update(tick=tick, period=period),
        get_clock=lambda: clock,
    )

    def spin(_):
        p, q = SimpleNamespace(x=0.0, y=0.0), SimpleNamespace(z=0.0, w=1.0)
        twist = SimpleNamespace(linear=SimpleNamespace(x=0.1), angular=SimpleNamespace(z=0.0))
        pose = SimpleNamespace(pose=SimpleNamespace(position=p, orientation=q))
        hooks["tick"]()
        hooks["heard"](SimpleNamespace(pose=pose, twist=SimpleNamespace(twist=twist)))
        hooks["tick"]()

    rclpy = ModuleType("rclpy")
    rclpy.init, rclpy.create_node, rclpy.spin = (lambda: None), (lambda name: node), spin
    modules = {"rclpy": rclpy}
    kinds = ("geometry_msgs", "Twist", Twist), ("nav_msgs", "Odometry", object)
    for package, name, kind in kinds:
        messages = ModuleType(f"{package}.msg")
        setattr(messages, name, kind)
        modules |= {package: ModuleType(package), f"{package}.msg": messages}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    example.spin(pilot)
    assert hooks["period"] == PAPER.dt
    assert written[0] == (0.0, 0.0)
    assert written[1][0] > 0.1
