"""What episodes are drawn from: one scenario, or a family of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from slipcar.envs.families import Family
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import MARK, parsed_object

#: What an environment draws its episodes' worlds from.
Source: TypeAlias = Scenario | Family


def source_of(value: Any) -> Source:
    """A scenario or a family from itself, a name, JSON text or plain data.

    Raises:
        ValueError: for anything else, listing the names.
    """
    if isinstance(value, (Scenario, Family)):
        return value
    if isinstance(value, str):
        if value.startswith("family:"):
            return Family.named(value.removeprefix("family:"))
        if not value.removeprefix(MARK).lstrip().startswith("{"):
            return Scenario.named(value)
        value = parsed_object(value, "scenario or family")
    # A family is told by its base: what a scenario must have, a start, it has not.
    if isinstance(value, Mapping) and "base" in value and "start" not in value:
        return Family.from_dict(value)
    return Scenario.of(value)


def base_of(source: Source) -> Scenario:
    """A scenario with what all worlds of a source share."""
    return source.base if isinstance(source, Family) else source


def most_obstacles(source: Source) -> int:
    """How many obstacles a world of the source may have."""
    return source.obstacles[1] if isinstance(source, Family) else len(source.obstacles)


def longest_horizon(source: Source) -> float:
    """The longest horizon of a world of the source [s]."""
    return source.horizon[1] if isinstance(source, Family) else source.horizon


def words_for_world(source: Source) -> int:
    """Random words that drawing a world takes."""
    return source.words if isinstance(source, Family) else 0


def chosen(
    sources: list[Source], which: np.ndarray, here: np.ndarray, given: Any
) -> tuple[list[Source], np.ndarray]:
    """Sources of many environments once some are given others.

    Args:
        sources: what there was to draw from.
        which: number of each environment's, (count,).
        here: environments that are given others, indices.
        given: one for all of them, or a list of `count`.

    Returns:
        What there is to draw from now, equal ones once, and each environment's number.

    Raises:
        ValueError: for what is no source, or a list of another length.
    """
    count = len(which)
    if isinstance(given, (list, tuple)):
        if len(given) != count:
            raise ValueError(f"scenario must be one or a list of {count}, not of {len(given)}")
        known = {id(value): source_of(value) for value in given}
        new = [known[id(value)] for value in given]
    else:
        new = [source_of(given)] * count
    now = [sources[number] for number in which]
    for i in here:
        now[i] = new[i]
    numbers: dict[Source, int] = {}
    which = np.array([numbers.setdefault(source, len(numbers)) for source in now])
    return list(numbers), which
