"""An overlay as pixels: the tube that the car stays in, some ellipses, the planned path."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs.overlay import RADIUS, Overlay
from slipcar.envs.pictures import sprites
from slipcar.envs.pictures.view import View

_ELLIPSES = 8  # drawn with a rim in a whole plan
_SMALLEST = 1.5  # [px]: an ellipse with less radius is lost under the path


def draw_overlay(pygame: Any, surface: Any, view: View, overlay: Overlay, *, nodes: int) -> None:
    """Draw a planned path under the trail, thin and translucent.

    Args:
        pygame: the module.
        surface: to draw on, of the view's size.
        view: where metres land on pixels.
        overlay: what to draw.
        nodes: of a whole plan. Ellipses are that far apart, counted from the plan's end: they
            stay where they are while the plans of a receding horizon get shorter.
    """
    path = view.pixels(overlay.positions)
    if overlay.covariances is not None:
        rims = view.pixels(overlay.ellipses())
        wide = np.linalg.norm(rims - path[:, None], axis=-1).max(axis=1) > _SMALLEST
        _fill_tube(pygame, surface, view, overlay, path, rims[wide])
        step = max(1, round(nodes / _ELLIPSES))
        from_end = np.arange(len(path))[::-1]
        for rim in rims[wide & (from_end % step == 0)].tolist():
            pygame.draw.aalines(surface, sprites.ELLIPSE, True, rim)
    if len(path) > 1:
        shifts = ((0.0, 0.0),) if view.small else ((0.0, 0.0), (0.6, 0.0), (0.0, 0.6))
        for shift in shifts:
            pygame.draw.aalines(surface, sprites.PLAN, False, (path + shift).tolist())


def _fill_tube(
    pygame: Any, surface: Any, view: View, overlay: Overlay, path: np.ndarray, rims: np.ndarray
) -> None:
    """The hull of each two neighbouring ellipses, all in one flat tint.

    On a sheet of their own, because translucent colours laid over one another add up.
    """
    if len(rims) == 0:
        return
    low = np.clip(np.floor(rims.min(axis=(0, 1))) - 1, 0, [view.width, view.height])
    high = np.clip(np.ceil(rims.max(axis=(0, 1))) + 1, 0, [view.width, view.height])
    if (high <= low).any():
        return
    sheet = pygame.Surface((high - low).tolist(), 0, 8)
    sheet.set_palette([sprites.PAPER, sprites.PLAN])
    sheet.set_colorkey(0)
    sheet.set_alpha(sprites.TUBE_ALPHA)
    for rim in (rims - low).tolist():
        pygame.draw.polygon(sheet, 1, rim)
    for corners in (_hulls(view, overlay, path) - low).tolist():
        pygame.draw.polygon(sheet, 1, corners)
    surface.blit(sheet, low.tolist())


def _hulls(view: View, overlay: Overlay, path: np.ndarray) -> np.ndarray:
    """Between two ellipses, where lines along the path touch them: corners (k − 1, 4, 2) [px].

    The line with normal n touches the ellipse of Σ at μ ± κ Σn / √(nᵀΣn).
    """
    assert overlay.covariances is not None
    along = np.diff(overlay.positions, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)  # of any length; zero makes a point

    def touched(S: np.ndarray) -> np.ndarray:
        Sn = np.einsum("kij,kj->ki", S, normal)
        spread = np.sqrt(np.maximum((normal * Sn).sum(axis=-1, keepdims=True), 0.0))
        reach = np.divide(RADIUS * Sn, spread, out=np.zeros_like(Sn), where=spread > 0.0)
        return reach * view.scale * (1.0, -1.0)  # rows of pixels go down

    first, last = touched(overlay.covariances[:-1]), touched(overlay.covariances[1:])
    return np.stack(
        [path[:-1] + first, path[1:] + last, path[1:] - last, path[:-1] - first], axis=1
    )
