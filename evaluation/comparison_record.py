"""The record of a comparison: what was run and what came of it.

:class:`slipcar.evaluation.Comparison` is one that can also write itself as text and figures.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.metrics import FIELDS, Result, leading
from slipcar.evaluation.statistics import Leader

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

#: Per-episode metrics whose paired differences against the reference row are shown.
DIFFERENCES = {
    "total_difference": "total",
    "collision_difference": "collision",
    "between_difference": "touched",
}


@dataclasses.dataclass(frozen=True)
class ComparisonRecord:
    """Rows of controllers over common Brownian paths.

    Attributes:
        scenario: the world.
        episodes: a row; the most, where they differ.
        seed: of the Brownian paths.
        substeps: Euler–Maruyama steps in each control interval.
        reference: name of the row that differences are taken against.
        controllers: name -> controller, in order.
        results: name -> result, of the rows that finished.
        errors: name -> message, of the rows that raised.
        reused: names of the rows that were read from the folder.
        warnings: what a reader must be told: intervals too wide, work that could not be kept.
        wall_time: seconds the comparison took.
        provenance: versions, machine, date, commit.
    """

    scenario: Scenario
    episodes: int
    seed: int
    substeps: int
    reference: str
    controllers: dict[str, Any]
    results: dict[str, Result]
    errors: dict[str, str]
    reused: tuple[str, ...]
    warnings: tuple[str, ...]
    wall_time: float
    provenance: dict[str, Any]

    def __repr__(self) -> str:
        failed = f", {len(self.errors)} failed" if self.errors else ""
        return (
            f"{type(self).__name__}({len(self.controllers)} rows{failed}, {self.episodes:,} "
            f"episodes, seed {self.seed}, reference {self.reference!r})"
        )

    def to_frame(self) -> pd.DataFrame:
        """The same as `frame`."""
        return self.frame

    def to_xarray(self) -> xr.Dataset:
        """Every per-episode metric over controller and episode, SI units. Needs xarray.

        Of several trainings it is the mean of each path; rows of fewer episodes end in nan.

        Raises:
            ImportError: without xarray.
        """
        try:
            import xarray as xr
        except ImportError as error:
            raise ImportError(f"to_xarray needs xarray ({error}): pip install xarray") from error
        names = list(self.results)
        metrics = ("total", *FIELDS)
        data = np.full((len(metrics), len(names), self.episodes), np.nan)
        for j, result in enumerate(self.results.values()):
            for i, metric in enumerate(metrics):
                data[i, j, : result.episodes] = result.per_path(metric)
        return xr.Dataset(
            {metric: (("controller", "episode"), data[i]) for i, metric in enumerate(metrics)},
            coords={"controller": names, "episode": np.arange(self.episodes)},
            attrs={"seed": self.seed, "substeps": self.substeps, "reference": self.reference},
        )

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """One row a controller, raw numbers in SI units; differences are to `reference`."""
        import pandas as pd

        rows = {}
        for name in self.controllers:
            row: dict[str, Any] = {"error": self.errors.get(name, "")}
            if name in self.results:
                row.update(self.results[name].summary())
                row.update(self._differences(name))
            rows[name] = row
        columns = list(dict.fromkeys(key for row in rows.values() for key in row if key != "error"))
        frame = pd.DataFrame.from_dict(rows, orient="index", columns=[*columns, "error"])
        return frame.rename_axis("controller")

    @functools.cached_property
    def leaders(self) -> dict[str, Leader | None]:
        """Who has the least mean cost, and the fewest collisions at and between nodes; who ties."""
        return {name: leading(self.results, name) for name in DIFFERENCES.values()}

    def _differences(self, name: str) -> dict[str, float]:
        found: dict[str, float] = {}
        for label, metric in DIFFERENCES.items():
            mean = low = high = float("nan")
            if name != self.reference and self.reference in self.results:
                reference = self.results[self.reference]
                mean, low, high = self.results[name].difference(reference, metric)
            found.update({label: mean, f"{label}_low": low, f"{label}_high": high})
        return found

    def to_csv(self, path: str | Path | None = None) -> str | None:
        """Raw numbers as CSV: the text, or None after writing it to `path`."""
        return self.frame.to_csv(path)
