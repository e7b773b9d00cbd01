"""How far rows are and how long they still take: bars where somebody watches, else lines of text.

Bars need a terminal, or a notebook with its widgets (ipywidgets). In a notebook without them, in a
pipe or a file, a row says when it is done, and every so often how far it is.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Mapping
from typing import Any

#: Seconds between two lines of text on rows that are not done.
PAUSE = 30.0
#: Seconds between two looks into a cell.
_REDRAWN = 0.1
#: No bar is drawn shorter than this.
_SHORTEST = 10


class Bars:
    """Progress of several rows that are worked on at once.

    Args:
        rows: name -> episodes in all.
        shown: whether to say anything.
        unit: what is counted.
    """

    def __init__(self, rows: Mapping[str, int], shown: bool = True, unit: str = "episodes") -> None:
        self._totals = dict(rows)
        self._done: dict[str, float] = dict.fromkeys(rows, 0.0)
        self._within: dict[str, dict[Any, float]] = {row: {} for row in rows}
        self._last = 0.0
        self._look: _Drawn | _Written | None = None
        if shown and rows:
            self._look = _Drawn(self._totals, unit) if _can_draw() else _Written(self._totals, unit)

    def __enter__(self) -> Bars:
        if self._look is not None:
            self._look.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._look is not None:
            self._look.stop()

    def advance(self, row: str, episodes: int, cell: Any = None) -> None:
        """So many more are done; they were the cell's, if it is named."""
        self._within[row].pop(cell, None)
        self._done[row] += episodes
        self._show(row)

    def within(self, row: str, cell: Any, episodes: float) -> None:
        """So many of a cell that is being worked on are done, parts of episodes counted."""
        self._within[row][cell] = episodes
        now = time.monotonic()
        if now - self._last > _REDRAWN:
            self._last = now
            self._show(row)

    def note(self, row: str, text: str) -> None:
        """Say something beside a row's bar."""
        if self._look is not None:
            self._look.note(row, text)

    def _show(self, row: str) -> None:
        if self._look is not None:
            self._look.show(row, self._done[row] + sum(self._within[row].values()))


def _can_draw() -> bool:
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_jupyter:
        return importlib.util.find_spec("ipywidgets") is not None
    return console.is_terminal


class _Drawn:
    """A bar for each row, drawn by rich on the standard error or by a notebook."""

    def __init__(self, totals: Mapping[str, int], unit: str) -> None:
        from rich import progress
        from rich.console import Console

        console = Console(stderr=True)
        width = max(map(len, totals))
        columns = _columns(unit, max(totals.values()), console.width - width)
        self._bars = progress.Progress(*columns, console=console)
        self._tasks = {
            row: self._bars.add_task(row.ljust(width), total=total, note="", start=False)
            for row, total in totals.items()
        }

    def start(self) -> None:
        self._bars.start()

    def stop(self) -> None:
        self._bars.stop()

    def show(self, row: str, done: float) -> None:
        self._bars.start_task(self._tasks[row])
        self._bars.update(self._tasks[row], completed=done)

    def note(self, row: str, text: str) -> None:
        self._bars.update(self._tasks[row], note=text)


def _columns(unit: str, most: int, room: int) -> list[Any]:
    """What stands in a bar's line, so much as there is room for beside the names, which may break.

    Numbers never do.
    """
    from rich import progress
    from rich.table import Column

    def text(form: str, whole: bool = True) -> Any:
        column = Column(no_wrap=whole, overflow="fold")
        return progress.TextColumn(form, markup=False, table_column=column)

    whole = Column(no_wrap=True)
    left = [text("left"), progress.TimeRemainingColumn(table_column=whole)]
    name, note = text("{task.description}", whole=False), text("{task.fields[note]}")
    counted = "{task.completed:,.0f} of {task.total:,.0f} " + unit
    elapsed = progress.TimeElapsedColumn(table_column=whole)
    need = len(f" {most:,} of {most:,} {unit} left 0:00:00 failed")
    if room > need + len("0:00:00 ") + _SHORTEST:
        return [name, progress.BarColumn(bar_width=None), text(counted), elapsed, *left, note]
    if room > need:
        return [name, text(counted), *left, note]
    return [name, text("{task.percentage:.0f} %"), *left, note]


class _Written:
    """A line for each row that is done, and now and then for those that are not."""

    def __init__(self, totals: Mapping[str, int], unit: str) -> None:
        from rich.console import Console

        self._totals, self._unit = totals, unit
        # A notebook shows what is written on the standard error as if it were one.
        self._file = sys.stdout if Console().is_jupyter else sys.stderr
        self._began: dict[str, float] = {}
        self._said: set[str] = set()
        self._last = time.monotonic()

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass

    def show(self, row: str, done: float) -> None:
        now, total = time.monotonic(), self._totals[row]
        elapsed = now - self._began.setdefault(row, now)
        if row in self._said or (done < total and now - self._last < PAUSE):
            return
        if done >= total:
            self._said.add(row)
        self._last = now
        left = ""
        if 0.0 < done < total:
            left = f", some {_seconds(elapsed * (total - done) / done)} left"
        counted = f"{done:,.0f} of {total:,}" if done < total else f"{total:,}"
        self._print(f"{row}: {counted} {self._unit}, {_seconds(elapsed)}{left}")

    def note(self, row: str, text: str) -> None:
        self._print(f"{row}: {text}")

    def _print(self, line: str) -> None:
        print(line, file=self._file, flush=True)


def _seconds(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
