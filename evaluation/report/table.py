"""A printed table, as plain data, and how it is made of a frame."""

from __future__ import annotations

import dataclasses
import math
import numbers
import re
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

#: What is printed where there is no number.
NONE = "–"


@dataclasses.dataclass(frozen=True)
class Table:
    """One printed table.

    Attributes:
        caption: above it.
        headers: one a column, with its unit; the first is the row names'.
        cells: text, [row][column].
        values: numbers to sort by, [row][column]; None where the text is the value, or there is
            no number.
        bold: (row, column) of the cells that are emphasised.
    """

    caption: str
    headers: tuple[str, ...]
    cells: tuple[tuple[str, ...], ...]
    values: tuple[tuple[float | None, ...], ...]
    bold: frozenset[tuple[int, int]] = frozenset()

    def __post_init__(self) -> None:
        width, height = len(self.headers), len(self.cells)
        if len(self.values) != height:
            raise ValueError(
                f"table {self.caption!r}: {height} rows of cells but {len(self.values)} of values"
            )
        for part in ("cells", "values"):
            for i, row in enumerate(getattr(self, part)):
                if len(row) != width:
                    raise ValueError(
                        f"table {self.caption!r}: row {i} of {part} has {len(row)} columns, "
                        f"not {width}"
                    )
        if wrong := [at for at in self.bold if not (0 <= at[0] < height and 0 <= at[1] < width)]:
            raise ValueError(f"table {self.caption!r}: bold {wrong[0]} is outside of the table")

    def numeric(self, column: int) -> bool:
        """Whether a column holds numbers, which are set flush right."""
        if any(row[column] is not None for row in self.values):
            return True
        return column > 0 and all(row[column] == NONE for row in self.cells)


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a printed table.

    Attributes:
        header: with its unit.
        text: from a row of the frame to what is printed.
        value: the key of the number to sort by; None takes the text.
        marked: the key that says of each row whether it is emphasised, or None.
    """

    header: str
    text: Callable[[Any], str]
    value: str | None = None
    marked: str | None = None


def table_of(frame: pd.DataFrame, caption: str, columns: tuple[Column, ...]) -> Table:
    """A printed table of a frame: a row a row, its index first.

    Those marked are emphasised: what is no winner beyond its interval should not be. A row whose
    `error` (if the frame has that column) is not empty prints nothing else than its name, and
    where a number is nan there is none.
    """
    rows = [row for _, row in frame.iterrows()]
    failed = [bool(row["error"]) if "error" in frame else False for row in rows]
    names = tuple(str(name) for name in frame.index)
    texts: list[tuple[str, ...]] = [names]
    bold: set[tuple[int, int]] = set()
    sorted_by: list[tuple[float | None, ...]] = [(None,) * len(rows)]
    for j, column in enumerate(columns, start=1):
        printed = [
            NONE if fails else column.text(row) for fails, row in zip(failed, rows, strict=True)
        ]
        key = column.value
        if key is not None:
            printed = [NONE if re.search(r"\bnan\b", text) else text for text in printed]
        there = [i for i, text in enumerate(printed) if text != NONE]
        if column.marked is not None:
            marks = list(frame[column.marked].eq(True))
            bold |= {(i, j) for i in there if marks[i]}
        texts.append(tuple(printed))
        sorted_by.append(
            tuple(
                None if key is None or text == NONE else _finite(row[key])
                for text, row in zip(printed, rows, strict=True)
            )
        )
    return Table(
        caption=caption,
        headers=(str(frame.index.name or "controller"), *(column.header for column in columns)),
        cells=tuple(zip(*texts, strict=True)),
        values=tuple(zip(*sorted_by, strict=True)),
        bold=frozenset(bold),
    )


def _finite(value: Any) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


#: Of a record: its column's header, the record's value there, and how a number of it is printed.
Field = tuple[str, Callable[[Any], Any], str]


def table_of_records(
    number: str, fields: Sequence[Field], records: Iterable[Any], first: int = 1
) -> Table:
    """A printed table of records, numbered from `first`: a row each, no caption.

    Numbers are printed as their field says, nan as none; any other value as its text.
    """
    cells, values = [], []
    for place, record in enumerate(records, start=first):
        row: list[tuple[str, float | None]] = [(str(place), float(place))]
        for _, value_of, form in fields:
            value = value_of(record)
            if isinstance(value, numbers.Real) and not isinstance(value, bool):
                nan = math.isnan(value)
                row.append((NONE, None) if nan else (format(value, form), _finite(value)))
            else:
                row.append((str(value), None))
        cells.append(tuple(text for text, _ in row))
        values.append(tuple(value for _, value in row))
    headers = (number, *(header for header, *_ in fields))
    return Table("", headers, tuple(cells), tuple(values))
