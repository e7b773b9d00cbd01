"""What a suite is, and the record of what came of it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.metrics import Result
from slipcar.evaluation.sweep import Row
from slipcar.planner.display import brief

if TYPE_CHECKING:
    import pandas as pd

#: Columns that differ from run to run: they go to a file of their own.
TIMES = ("inference_time", "preparation_time")


@dataclasses.dataclass(frozen=True)
class Variant:
    """A world of a suite.

    Attributes:
        label: in the tables.
        value: of what varies: α², the number of nodes, the number of the world.
        scenario: where.
        substeps: Euler–Maruyama steps in each control interval.
    """

    label: str
    value: float
    scenario: Scenario
    substeps: int = 1


@dataclasses.dataclass(frozen=True)
class Suite:
    """What is to be run.

    Attributes:
        name: "random", "slip", "horizon".
        rows: by name, in the order of the tables.
        variants: in order.
        episodes: of each row in each variant.
        reference: row that others are compared with.
        notes: what a reader must be told beforehand.
    """

    name: str
    rows: Mapping[str, Row]
    variants: Sequence[Variant]
    episodes: int
    reference: str
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class SuiteResult:
    """What came of a suite.

    Attributes:
        suite: what was run.
        seed: of the Brownian paths.
        results: (row, variant's label) -> result, of what finished.
        errors: (row, variant's label) -> message.
        computed: cells that were computed; the others were there.
        warnings: what a reader must be told.
        wall_time: seconds it took.
        provenance: versions, machine, date, commit.
    """

    suite: Suite
    seed: int
    results: dict[tuple[str, str], Result]
    errors: dict[tuple[str, str], str]
    computed: int
    warnings: tuple[str, ...]
    wall_time: float
    provenance: dict[str, Any]

    __repr__ = brief

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """One line a row and variant, raw numbers in SI units; differences are to the reference."""
        import pandas as pd

        lines = []
        for row in self.suite.rows:
            for variant in self.suite.variants:
                line: dict[str, Any] = {
                    "controller": row,
                    "variant": variant.label,
                    "value": variant.value,
                    "nodes": variant.scenario.nodes,
                    "substeps": variant.substeps,
                }
                result = self.results.get((row, variant.label))
                if result is not None:
                    line |= result.summary()
                    line |= self._difference(row, variant.label)
                line["error"] = self.errors.get((row, variant.label), "")
                lines.append(line)
        return pd.DataFrame(lines)

    def _difference(self, row: str, label: str) -> dict[str, float]:
        reference = self.results.get((self.suite.reference, label))
        if reference is None or row == self.suite.reference:
            return {}
        found = self.results[row, label].difference(reference, "total")
        return {f"total_difference{end}": value for end, value in zip(
            ("", "_low", "_high"), found, strict=True
        )}  # fmt: skip

    @property
    def failed(self) -> list[str]:
        """One line for each row that raised somewhere."""
        lines = []
        for row in self.suite.rows:
            where = [label for name, label in self.errors if name == row]
            if where:
                first = self.errors[row, where[0]]
                others = f" and {len(where) - 1} more" if len(where) > 1 else ""
                lines.append(f"{row} did not finish in {where[0]}{others}: {first}")
        return lines
