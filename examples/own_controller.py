"""A controller of one's own: a path drawn by hand, followed by a tracking law, in a few lines.

    slipcar compare --controller mine=examples/own_controller.py:controller

A function of (t, x) is all it takes. It is called with the time [s] and the states of many cars at
once, x (rows, 5), and gives the controls (rows, 2) [m/s², rad/s²]; what is beyond the scenario's
bounds is clipped. Run as a script, it says how well it drives.

The path turns left and back, θ(t) = A sin²(πt/T) at the speed v(t) = V sin(πt/T); with these A and
V it ends at the goal of the `paper` scenario and happens to pass between the obstacles. It is
followed as Kanayama et al. do (A stable tracking control method, ICRA 1990), errors being seen
from the car.
"""

import numpy as np

from slipcar.envs import Scenario

TURN, SPEED = 1.394, 1.276
#: Gains on the error ahead [1/s], to the left [1/m²] and in heading [1/m]; of the two speeds [1/s].
AHEAD, LEFT, HEADING, FOLLOW = 1.0, 2.0, 4.0, 4.0

SCENARIO = Scenario.named("paper")
T, TIMES = SCENARIO.horizon, SCENARIO.times


def drawn(t):
    """Heading, speed and turning rate of the path drawn by hand."""
    phase = np.pi * t / T
    return (
        TURN * np.sin(phase) ** 2,
        SPEED * np.sin(phase),
        TURN * np.pi / T * np.sin(2.0 * phase),
    )


_THETA, _V, _ = drawn(TIMES)
_VELOCITY = _V[:, None] * np.stack([np.cos(_THETA), np.sin(_THETA)], axis=-1)
#: Its positions, added up as the car's are, (N, 2).
PATH = np.vstack([np.zeros(2), np.cumsum(SCENARIO.dt * _VELOCITY[:-1], axis=0)])


def controller(t, x):
    """Controls (rows, 2) at time t for states x (rows, 5) = (r_x, r_y, θ, v, ω)."""
    theta, v, omega = drawn(t)
    dx, dy = (np.interp(t, TIMES, PATH[:, i]) - x[:, i] for i in range(2))
    cos, sin = np.cos(x[:, 2]), np.sin(x[:, 2])
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    off = theta - x[:, 2]
    wanted_v = v * np.cos(off) + AHEAD * ahead
    wanted_omega = omega + v * (LEFT * left + HEADING * np.sin(off))
    # And what the drawn path itself needs: its accelerations.
    later = drawn(t + 0.5 * SCENARIO.dt), drawn(t - 0.5 * SCENARIO.dt)
    _, a_v, a_omega = ((after - before) / SCENARIO.dt for after, before in zip(*later, strict=True))
    return np.stack(
        [a_v + FOLLOW * (wanted_v - x[:, 3]), a_omega + FOLLOW * (wanted_omega - x[:, 4])], axis=-1
    )


if __name__ == "__main__":
    from slipcar.evaluation import compare
    from slipcar.evaluation.own import as_controller
    from slipcar.planner import Feedback, plan

    planned = plan(SCENARIO)
    print(f"plan: {planned.status.name}")
    rows = {
        "tracked SCP": Feedback(planned),
        "drawn by hand": as_controller(controller, SCENARIO),
    }
    frame = compare(rows, SCENARIO, episodes=2000, progress=False).frame
    print(frame[["total", "effort", "collision_rate", "position_rms"]].round(3))
