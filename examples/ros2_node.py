"""A ROS 2 node that drives a robot by receding horizon, at 8 Hz and with a deadline of 5 ms.

    python examples/ros2_node.py        without ROS: the same pilot drives a simulated car

It hears /odom (nav_msgs/Odometry) and writes /cmd_vel (geometry_msgs/Twist); `Pilot` decides.
"""

import math

import numpy as np

from slipcar.envs import Scenario
from slipcar.planner import RecedingHorizon

DEADLINE, STALE = 5e-3, 0.5  #: [s] for an answer; without odometry until it stops


class Pilot:
    """From odometry to commanded speeds; times in seconds on any one clock."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.controller = scenario, RecedingHorizon(scenario)
        self.began = self.latest = self.state = None

    def observe(self, now, x, y, qz, qw, v, omega):
        """Odometry: position, the quaternion of a turn about z, speeds."""
        state = np.array([x, y, 2.0 * math.atan2(qz, qw), v, omega])
        if np.isfinite(state).all():  # a bad message is as none
            self.latest, self.state = now, state

    def command(self, now):
        """Speeds (v [m/s], ω [rad/s]) to hold until the next call; zeros to stand still."""
        if self.state is None or now - self.latest > STALE:
            return 0.0, 0.0
        self.began = now if self.began is None else self.began
        if (t := now - self.began) >= self.scenario.horizon - 0.5 * self.scenario.dt:
            return 0.0, 0.0
        u = self.controller.step(self.state, t, deadline=DEADLINE)
        v, omega = self.state[3:] + self.scenario.dt * u  # u is accelerations
        return float(v), float(omega)


def spin(pilot: Pilot) -> None:
    """The node."""
    import rclpy
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry

    rclpy.init()
    node = rclpy.create_node("slipcar")
    publisher, out = node.create_publisher(Twist, "cmd_vel", 1), Twist()

    def now():
        return node.get_clock().now().nanoseconds * 1e-9

    def heard(m):
        p, q, w = m.pose.pose.position, m.pose.pose.orientation, m.twist.twist
        pilot.observe(now(), p.x, p.y, q.z, q.w, w.linear.x, w.angular.z)

    def tick():
        out.linear.x, out.angular.z = pilot.command(now())
        publisher.publish(out)

    node.create_subscription(Odometry, "odom", heard, 1)
    node.create_timer(pilot.scenario.dt, tick)
    rclpy.spin(node)


if __name__ == "__main__":
    pilot = Pilot(Scenario.named("paper"))
    try:
        spin(pilot)
    except ImportError:
        s, x, rng = pilot.scenario, pilot.scenario.start, np.random.default_rng(0)
        for t in s.times[:-1]:
            pilot.observe(t, *x[:2], math.sin(x[2] / 2), math.cos(x[2] / 2), *x[3:])
            u = (np.array(pilot.command(t)) - x[3:]) / s.dt
            x = x + s.dt * s.drift(t, x, u) + s.diffusion(t, x) @ rng.normal(0, s.dt**0.5, 3)
        print(f"{pilot.controller.status}, {np.hypot(*(x - s.goal)[:2]):.3f} m from the goal")
