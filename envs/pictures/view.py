"""Where metres land on pixels."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario

CAR_LENGTH, CAR_WIDTH = 0.30, 0.17  # [m]


@dataclasses.dataclass(frozen=True)
class View:
    """A window on the plane: equal scales, y up.

    Attributes:
        left: x of the left edge [m].
        bottom: y of the lower edge [m].
        scale: pixels per metre.
        width: of the picture [px].
        height: of the picture [px].
    """

    left: float
    bottom: float
    scale: float
    width: int
    height: int

    @staticmethod
    def of(scenario: Scenario, width: int, height: int) -> View:
        """The view of this size that shows start, goal and every clearance ring, with a margin."""
        low, high = _extent(scenario)
        extent = high - low
        scale = float(min(width / extent[0], height / extent[1]))
        left, bottom = 0.5 * (low + high) - 0.5 * np.array([width, height]) / scale
        return View(float(left), float(bottom), scale, width, height)

    @property
    def small(self) -> bool:
        """Whether there is room for thin lines alone, and none for words."""
        return self.width < 400

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """Pixel coordinates (..., 2) of positions (..., 2) [m], finite and not absurdly far.

        A car may leave the view; pygame takes no coordinates beyond the range of a C int.
        """
        far = 4.0 * max(self.width, self.height)
        x = (positions[..., 0] - self.left) * self.scale
        y = self.height - (positions[..., 1] - self.bottom) * self.scale
        return np.clip(np.nan_to_num(np.stack([x, y], axis=-1)), -far, far)


def aspect(scenario: Scenario) -> float:
    """Height over width of what there is to see."""
    low, high = _extent(scenario)
    return float((high[1] - low[1]) / (high[0] - low[0]))


def grid_step(scale: float) -> float:
    """Distance between grid lines [m]: 1, 2, 5, 10, ..., at least 40 pixels apart."""
    step = 1.0
    for factor in (2.0, 2.5, 2.0) * 100:
        if step * scale >= 40.0:
            break
        step *= factor
    return step


def _extent(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of all there is, with a margin, (2,) each [m]."""
    centres = np.vstack([scenario.start[:2], scenario.goal[:2], scenario.obstacles[:, :2]])
    reach = np.full(len(centres), CAR_LENGTH)
    reach[2:] = scenario.obstacles[:, 2] + scenario.clearance
    low = (centres - reach[:, None]).min(axis=0)
    high = (centres + reach[:, None]).max(axis=0)
    margin = max(0.2, 0.06 * float((high - low).max()))
    return low - margin, high + margin
