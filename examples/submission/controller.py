"""Template of a submission: replace the law, keep the shape.

    slipcar compare --controller mine=examples/submission/controller.py:controller
    slipcar compare --suite random --controller mine=examples/submission/controller.py:controller

`controller(scenario)` is called once for each world and gives a function of time and states, or any
object with Stable-Baselines3's `predict` (docs/controllers.md). It must draw no random numbers that
do not follow from what it is shown, and must not look at the noise.
"""

import numpy as np


def controller(scenario):
    """Steer towards the goal and slow down in time for it; obstacles are ignored."""
    goal, T = scenario.goal, scenario.horizon

    def law(t, x):
        """Controls (rows, 2) = (a_v, a_ω) at time t [s] in states x (rows, 5)."""
        ahead = goal[:2] - x[:, :2]
        distance = np.hypot(ahead[:, 0], ahead[:, 1])
        bearing = np.arctan2(ahead[:, 1], ahead[:, 0]) - x[:, 2]
        bearing = np.arctan2(np.sin(bearing), np.cos(bearing))
        speed = 1.5 * distance * np.cos(bearing) / (T - t + 0.5)
        a_omega = 4.0 * bearing * np.minimum(distance, 1.0) - 3.0 * x[:, 4]
        return np.stack([2.0 * (speed - x[:, 3]), a_omega], axis=-1)

    return law
