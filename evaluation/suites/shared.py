"""What the documents of all suites have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slipcar.evaluation.suites.records import TIMES, SuiteResult

if TYPE_CHECKING:
    import pandas as pd


def frames(result: SuiteResult) -> dict[str, pd.DataFrame]:
    """Raw numbers of every row in every variant, and, apart, the times, which differ each run."""
    whole = result.frame.set_index(["controller", "variant"])
    flat = result.frame.copy()
    flat.index = flat["controller"] + ", " + flat["variant"]
    flat = flat.rename_axis("cell")
    times = [name for name in TIMES if name in whole]
    return {"cells": flat.drop(columns=times), "times": flat[["controller", "variant", *times]]}


def notes(result: SuiteResult) -> tuple[str, ...]:
    """Rows that raised, plans that failed, what could not be kept."""
    return (*result.suite.notes, *result.failed, *result.warnings)
