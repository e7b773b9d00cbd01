"""A bar for each row on the standard error, or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class Bars:
    """Progress of several rows that are worked on at once.

    Args:
        rows: name -> episodes in all.
        shown: whether to draw them.
        unit: what is counted.
    """

    def __init__(self, rows: Mapping[str, int], shown: bool = True, unit: str = "episodes") -> None:
        self._rows = dict(rows)
        self._tasks: dict[str, Any] = {}
        self._bars: Any = None
        if shown and rows:
            from rich import progress
            from rich.console import Console

            self._width = max(map(len, rows))
            self._bars = progress.Progress(
                progress.TextColumn("{task.description}", markup=False),
                progress.BarColumn(),
                progress.TextColumn("{task.completed:,.0f} of {task.total:,.0f} " + unit),
                progress.TimeElapsedColumn(),
                progress.TextColumn("{task.fields[note]}", markup=False),
                console=Console(stderr=True),
            )

    def __enter__(self) -> Bars:
        if self._bars is not None:
            self._bars.start()
            for row, total in self._rows.items():
                self._tasks[row] = self._bars.add_task(
                    row.ljust(self._width), total=total, note="", start=False
                )
        return self

    def __exit__(self, *error: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def advance(self, row: str, episodes: int) -> None:
        """So many more are done."""
        if self._bars is not None:
            self._bars.start_task(self._tasks[row])
            self._bars.advance(self._tasks[row], episodes)

    def extend(self, row: str, episodes: int) -> None:
        """So many are to be done in all."""
        if self._bars is not None:
            self._bars.update(self._tasks[row], total=episodes)

    def note(self, row: str, text: str) -> None:
        """Say something beside a row's bar."""
        if self._bars is not None:
            self._bars.update(self._tasks[row], note=text)
