"""Names written beside what they name: each where it covers least, so that no legend is needed."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.transforms import Bbox

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Directions tried, the readable first, and distances [points]; beyond `_LEADER` a thin line
#: leads from the name to what it names.
_DIRECTIONS = (
    *((1, 0), (1, 1), (1, -1), (0, 1), (0, -1), (-1, 0), (-1, 1), (-1, -1)),
    *((1, 0.5), (1, -0.5), (0.5, 1), (0.5, -1), (-1, 0.5), (-1, -0.5), (-0.5, 1), (-0.5, -1)),
)
_DISTANCES = (7.0, 11.0, 16.0, 24.0, 34.0, 46.0, 60.0, 76.0)
_LEADER = 18.0
#: Half-width of the square that a marker is taken to cover [points].
_MARKER = 5.0


@dataclasses.dataclass(frozen=True)
class Label:
    """A name to be placed.

    Attributes:
        text: what to write.
        anchors: (k, 2) in data coordinates; it is written beside whichever leaves most room, the
            first if they are alike.
        colour: of the text.
        optional: left out rather than written over something or far away.
        look: further properties of the text.
    """

    text: str
    anchors: np.ndarray
    colour: str
    optional: bool = False
    look: dict[str, Any] = dataclasses.field(default_factory=dict)


def place(
    axes: Axes, labels: Sequence[Label], markers: np.ndarray, lines: Sequence[np.ndarray]
) -> None:
    """Write the labels, in order, each beside an anchor where it covers least.

    Args:
        axes: drawn to, with its limits and scales settled.
        labels: the important first.
        markers: (k, 2) points not to be covered, in data coordinates.
        lines: polylines (k, 2) likewise.
    """
    figure: Any = axes.figure
    figure.draw_without_rendering()  # a constrained layout settles now
    pixels = figure.dpi / 72.0
    inside = axes.get_window_extent()
    taken = [_square(at, _MARKER * pixels) for at in axes.transData.transform(markers)]
    strokes = [_sampled(axes.transData.transform(line)) for line in lines if len(line) > 1]
    ink = np.concatenate([*strokes, np.empty((0, 2))])
    for label in labels:
        text = axes.annotate(
            label.text,
            xy=tuple(label.anchors[0]),
            xytext=(0, 0),
            textcoords="offset points",
            color=label.colour,
            zorder=6,
            in_layout=False,
            **label.look,
        )
        extent = text.get_window_extent()
        anchors = axes.transData.transform(label.anchors)
        ground = _Ground(inside, taken, ink, pixels)
        index, _, box, distance = min(_candidates(anchors, extent, pixels), key=ground.badness)
        if label.optional and (distance > _LEADER or ground.covers(box)):
            text.remove()
            continue
        taken.append(box)
        text.xy = tuple(label.anchors[index])
        # What is drawn is moved from where it was measured, at the first anchor, by so much.
        offset = (box.p0 - extent.p0 - (anchors[index] - anchors[0])) / pixels
        text.set_position(tuple(offset))
        if distance > _LEADER:
            end = np.clip(anchors[index], box.p0, box.p1)  # of the box, the nearest point
            ink = np.concatenate([ink, _sampled(np.array([end, anchors[index]]))])
            axes.annotate(
                "",
                xy=tuple(label.anchors[index]),
                xytext=tuple((end - anchors[index]) / pixels),
                textcoords="offset points",
                arrowprops={
                    "arrowstyle": "-",
                    "color": label.colour,
                    "linewidth": 0.6,
                    "shrinkA": 1.0,
                    "shrinkB": 4.0,
                },
                in_layout=False,
            )


class Place(NamedTuple):
    """Where a text might go: beside which anchor, its box [pixels], how far off [points]."""

    which: int
    anchor: np.ndarray
    box: Bbox
    distance: float


def _candidates(anchors: np.ndarray, extent: Bbox, pixels: float) -> Iterable[Place]:
    """All places that are tried."""
    size = np.array([extent.width, extent.height])
    for (i, anchor), distance, direction in itertools.product(
        enumerate(anchors), _DISTANCES, _DIRECTIONS
    ):
        way = np.array(direction, dtype=float)
        reach = distance * pixels / max(1.0, float(np.hypot(*way)))
        corner = anchor + way * reach + (way - 1.0) * 0.5 * size
        yield Place(i, anchor, Bbox([corner, corner + size]), distance)


class _Ground(NamedTuple):
    """What is there already, in pixels: the axes, boxes, and points of lines; pixels a point."""

    inside: Bbox
    taken: list[Bbox]
    ink: np.ndarray
    pixels: float

    def badness(self, place: Place) -> float:
        """How much a place is to be avoided: what it covers first, then how far away it is."""
        box = place.box
        # Of a curve's anchors the first are preferred: its end.
        covered = sum(_overlap(box.padded(1.5 * self.pixels), other) for other in self.taken)
        crossed = _within(box.padded(2.0 * self.pixels), self.ink)
        cost = 20.0 * covered / self.pixels**2 + 30.0 * crossed + place.distance
        cost += 3.0 * place.which
        if place.distance > _LEADER:
            end = np.clip(place.anchor, box.p0, box.p1)
            way = _sampled(np.array([end, place.anchor]))
            way = way[np.hypot(*(way - place.anchor).T) > 1.5 * _MARKER * self.pixels]
            cost += 15.0 * sum(_within(other, way) for other in self.taken)
        return cost + 1e4 * self._outside(box)

    def covers(self, box: Bbox) -> bool:
        """Whether a text there would hide anything or be cut off."""
        padded = box.padded(1.5 * self.pixels)
        hidden = any(_overlap(padded, other) > 0.0 for other in self.taken)
        return hidden or _within(padded, self.ink) > 0 or self._outside(box) > 0.0

    def _outside(self, box: Bbox) -> float:
        low, high = self.inside.p0 - box.p0, box.p1 - self.inside.p1
        return max(0.0, *low, *high)


def _square(at: np.ndarray, half: float) -> Bbox:
    return Bbox([at - half, at + half])


def _overlap(a: Bbox, b: Bbox) -> float:
    """Area that two boxes have in common [pixels²]."""
    width = min(a.x1, b.x1) - max(a.x0, b.x0)
    height = min(a.y1, b.y1) - max(a.y0, b.y0)
    return max(width, 0.0) * max(height, 0.0)


def _within(box: Bbox, points: np.ndarray) -> int:
    inside = (points > box.p0) & (points < box.p1)
    return int(inside.all(axis=1).sum())


def _sampled(line: np.ndarray, spacing: float = 4.0) -> np.ndarray:
    """Points along a polyline, about so many pixels apart."""
    parts = []
    for a, b in itertools.pairwise(line):
        count = max(2, int(np.hypot(*(b - a)) / spacing))
        parts.append(a + np.linspace(0.0, 1.0, count)[:, None] * (b - a))
    return np.concatenate(parts)
