"""A learned method is not one policy: several trainings of it, as one row."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Any

from slipcar.evaluation.controller import Controller, check_controller


@dataclasses.dataclass(frozen=True)
class Runs:
    """Policies that differ in nothing but the seed of their training.

    As a row of a comparison every one of them drives all paths; the row shows their mean, with
    errors for the method (trainings and paths together) and the spread between them.

    Attributes:
        controllers: the policies, at least one.
        labels: what each is called, such as "seed 0".
    """

    controllers: tuple[Controller, ...]
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.controllers or len(self.controllers) != len(self.labels):
            raise ValueError(
                f"runs need at least one controller and a label for each, not "
                f"{len(self.controllers)} and {len(self.labels)}"
            )
        if len(set(self.labels)) < len(self.labels):
            raise ValueError(f"the labels of runs must differ: {list(self.labels)}")
        for controller in self.controllers:
            check_controller(controller)

    @classmethod
    def of(cls, policies: Sequence[Controller]) -> Runs:
        """Policies under the seeds they were trained with, as far as they say."""
        seeds = [getattr(policy, "training", {}).get("seed") for policy in policies]
        known = None not in seeds and len(set(seeds)) == len(seeds)
        labels = [f"seed {seed}" if known else f"run {i}" for i, seed in enumerate(seeds)]
        return cls(tuple(policies), tuple(labels))

    def fingerprint(self) -> str | None:
        """Identifies all of them; None if one cannot be identified."""
        from slipcar.evaluation.cells import controller_fingerprint

        told = [controller_fingerprint(controller) for controller in self.controllers]
        if None in told:
            return None
        return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def trainings(row: Any) -> dict[str, Any]:
    """Label -> controller of everything behind a row; a single one has no label."""
    if isinstance(row, Runs):
        return dict(zip(row.labels, row.controllers, strict=True))
    return {"": row}
