"""The car drives while its world is dragged: receding horizon, in the world as it is now.

At every tick the controller steps once (:meth:`slipcar.planner.RecedingHorizon.step`) and the car
moves one interval by its own noise. Where the world has changed since the last tick, the rest of
the way is planned anew: from where the car is, with the intervals that are left.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs import Scenario
from slipcar.evaluation.live.picture import Picture, drawn, ellipses, numbers
from slipcar.evaluation.live.request import Request
from slipcar.planner import RecedingHorizon

_PLANE = [0, 1]


class Drive:
    """One episode.

    Args:
        scenario: the world at the start.
        seed: of the noise.

    Attributes:
        done: whether the horizon is reached.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._world = scenario
        self._nodes = scenario.nodes
        self._began = 0  # the interval the current plan begins at
        self._asked: Request | None = None
        self._controller: RecedingHorizon | None = None
        spread = scenario.start_deviation
        self._trail = [scenario.start + spread * self._rng.standard_normal(5)]
        self._collided = False

    @property
    def done(self) -> bool:
        """Whether the last interval has been driven."""
        return len(self._trail) >= self._nodes

    def tick(self, request: Request, scenario: Scenario) -> Picture:
        """Drive one interval in the world as it is now.

        Raises:
            ValueError: if there is no plan to follow, saying why.
        """
        k, x = len(self._trail) - 1, self._trail[-1]
        changed = self._asked is None or scenario != self._world
        changed = changed or request.price != self._asked.price  # type: ignore[union-attr]
        if changed or self._controller is None:
            self._controller = RecedingHorizon(self._rest(scenario, k), risk_price=request.price)
            self._world, self._began, self._asked = scenario, k, request
        controller, dt = self._controller, scenario.dt
        u = controller.step(x, (k - self._began) * dt)
        sigma = scenario.diffusion(0.0, x)
        noise = sigma @ self._rng.standard_normal(sigma.shape[-1])
        self._trail.append(x + dt * scenario.drift(0.0, x, u) + np.sqrt(dt) * noise)
        rim = scenario.constraint(0.0, self._trail[-1])
        self._collided |= bool((rim > 0.0).any())
        return self._picture(controller, scenario)

    def _rest(self, scenario: Scenario, k: int) -> Any:
        """The task from where the car is; it may be inside an obstacle, where none may start."""
        left = self._nodes - 1 - k
        shorter = scenario.replace(nodes=left + 1, horizon=left * scenario.dt)
        # The car's state is known from here on.
        return shorter.replace(start_deviation=0.0).reposed(start=self._trail[-1])

    def _law(self, controller: RecedingHorizon, scenario: Scenario) -> Any:
        """The latest plan's feedback law, from where the car is; t counts from there."""
        begun = len(self._trail) - 1 - self._began
        assert controller.underway is not None
        x, u, gains = (controller.underway.plans[name][0] for name in ("x", "u", "gains"))

        def control(t: float, states: np.ndarray) -> np.ndarray:
            k = begun + round(t / scenario.dt)
            played = u[k] + (states - x[k]) @ gains[k].T
            bounds = scenario.control_bounds
            return played if bounds is None else np.clip(played, -bounds, bounds)

        return control

    def _picture(self, controller: RecedingHorizon, scenario: Scenario) -> Picture:
        mean, covariance = controller.preview(controller.underway)
        ahead: dict[str, Any] = {"hits": None}
        arrays: dict[str, Any] = {}
        if not self.done:
            rest = self._rest(scenario, len(self._trail) - 1)
            ahead, arrays = drawn(rest, self._law(controller, scenario), _PLANE)
        trail = np.array(self._trail)
        off = np.abs(trail[-1] - scenario.goal)
        arrived = self.done and bool((off <= scenario.goal_tolerance).all())
        facts = numbers(controller.plan) | ahead | {
            "drive": {
                "done": self.done, "collided": self._collided, "arrived": arrived,
                "off": float(np.hypot(*off[:2])), "step": len(trail) - 1, "steps": self._nodes - 1,
                "dt": scenario.dt, "replans": controller.replans,
            },
            "predicted": None,  # of a whole plan, from its own start
        }  # fmt: skip
        arrays |= {"mean": mean[:, _PLANE], "trail": trail[:, _PLANE]}
        arrays["ellipses"] = ellipses(mean, covariance, _PLANE)
        return Picture(facts, arrays)
