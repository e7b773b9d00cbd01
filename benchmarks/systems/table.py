"""Rows as they come: progress that is a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Protocol, TypeVar


class Record(Protocol):
    """What a measurement yields."""

    def row(self) -> dict[str, Any]:
        """Its row: cells by column."""
        ...


Kind = TypeVar("Kind", bound=Record)

#: Columns that may be wider than their heading.
_WIDTHS = {"system": 11, "status": 14, "there": 14, "cost": 10, "IPOPT": 10, "units": 10}
_LEAST = 8


def printed(records: Iterable[Kind]) -> Iterator[Kind]:
    """The records, each printed as a row when it comes."""
    for number, record in enumerate(records):
        row = record.row()
        widths = [max(len(key), _WIDTHS.get(key, _LEAST)) for key in row]
        for cells in ([row.keys()] if number == 0 else []) + [row.values()]:
            line = (str(cell).rjust(width) for cell, width in zip(cells, widths, strict=True))
            print("  ".join(line), flush=True)
        yield record


def yes(true: bool) -> str:
    """A flag as a cell."""
    return "yes" if true else "no"
