"""How a printed table fits the width there is: no number is ever cut.

First headers and text break between words; then columns are stacked, so many as fit beside the row
names at a time; and where not even one fits, or cells are whole sentences, each row becomes a list
of `header: text`. Cells that are numbers stay on one line.
"""

from __future__ import annotations

import dataclasses
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from slipcar.evaluation.report.table import Table

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.text import Text

#: Holds two words together while text is broken.
_TIE = "\u00a0"
#: Between columns; of a list's lines.
_GAP, _INDENT = "  ", "    "
#: No text is broken to less than this, unless its longest word is shorter.
_NARROWEST = 24
_BOLD = "bold green"


@dataclasses.dataclass(frozen=True)
class Fitted:
    """A table for a rich console, laid out when its width is known."""

    table: Table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        """Its lines, each at most as wide as the console."""
        yield from lines(self.table, options.max_width)


@dataclasses.dataclass(frozen=True)
class Prose:
    """A paragraph for a rich console, broken between words; further lines may be indented."""

    text: str
    style: str = ""
    indent: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        """Its lines."""
        from rich.text import Text

        first, *rest = broken(self.text, max(1, options.max_width)) or [""]
        if rest and self.indent:
            after = self.text[len(first) :].strip()
            rest = broken(after, max(1, options.max_width - len(self.indent)))
        yield Text(first, self.style)
        yield from (Text(self.indent + part, self.style) for part in rest)


def lines(table: Table, width: int) -> Iterator[Text]:
    """The lines of a table that is at most so many columns wide.

    A list's lines may break between words, and a word that is wider than all of it anywhere.
    """
    from rich.text import Text

    low, high = _least(table, width), _widest(table)
    columns = range(len(table.headers))
    if _total(high) <= width or _total(low) <= width:
        blocks = [list(columns)]
    elif any(high[j] > width // 2 for j in columns[1:] if not table.numeric(j)):
        blocks = []  # sentences beside each other would be columns of single words
    else:
        blocks = _stacked(low, high, width)
    if not blocks:
        yield from _listed(table, width)
    for number, block in enumerate(blocks):
        if number:
            yield Text()
        yield from _drawn(table, block, _shared(low, high, block, width))


def broken(text: str, width: int) -> list[str]:
    """Text in lines of at most `width`; what belongs to one number stays together.

    Where there is no room for all of that it is broken between its words, a longer word anywhere.
    """
    options: Any = {"width": max(1, width), "break_on_hyphens": False}
    found: list[str] = []
    for part in textwrap.wrap(_kept(text), break_long_words=False, **options):
        part = part.replace(_TIE, " ")
        found += [part] if len(part) <= width else textwrap.wrap(part, **options)
    return found or [""]


def _kept(text: str) -> str:
    """Numbers keep sign, error, unit and interval: "≤ 0.1 %", "5.0 ± 0.1", "1.0 [0.8, 1.2]"."""
    return re.sub(
        r"(?<=[≤≥<>±=]) (?=[\d.+-])|(?<=\d) (?=[±%])|(?<=[\d%]) (?=\[[\d+-])|(?<=\d,) (?=[^ ]*\])",
        _TIE,
        text,
    )


def _words(text: str) -> int:
    return max(map(len, _kept(text).split(" ")), default=0)


def _widest(table: Table) -> list[int]:
    """Width of each column whose texts are not broken."""
    return [
        max([len(table.headers[j]), *(len(row[j]) for row in table.cells)])
        for j in range(len(table.headers))
    ]


def _least(table: Table, width: int) -> list[int]:
    """Least width of each column: of its numbers, of the longest word of its header and texts.

    Row names are broken only where they would take much of the width.
    """
    found = []
    for j, header in enumerate(table.headers):
        cells = [row[j] for row in table.cells]
        if table.numeric(j):
            least = max(map(len, cells), default=0)
        else:
            most = _NARROWEST if j else max(_NARROWEST, 2 * width // 5)
            widest = max(map(len, cells), default=0)
            least = max([min(widest, most), *map(_words, cells)])
        found.append(max(least, _words(header)))
    return found


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + len(_GAP) * (len(widths) - 1)


def _stacked(low: Sequence[int], high: Sequence[int], width: int) -> list[list[int]]:
    """Columns of each block, the row names first in all; none if some column fits beside none."""
    names = low[0]
    blocks: list[list[int]] = []
    room = 0
    for j in range(1, len(low)):
        need = len(_GAP) + low[j]
        if not blocks or need > room:
            blocks.append([0])
            room = width - names
            if need > room:
                return []
        blocks[-1].append(j)
        room -= need
    return blocks


def _shared(
    low: Sequence[int], high: Sequence[int], block: Sequence[int], width: int
) -> dict[int, int]:
    """Width of each column of a block: what is left over goes where most is broken."""
    widths = {j: low[j] for j in block}
    spare = width - _total(list(widths.values()))
    while spare > 0:
        squeezed = [j for j in block if widths[j] < high[j]]
        if not squeezed:
            break
        widths[max(squeezed, key=lambda j: high[j] / max(widths[j], 1))] += 1
        spare -= 1
    return widths


def _drawn(table: Table, block: Sequence[int], widths: dict[int, int]) -> Iterator[Text]:
    """A header, a rule and the rows, of some of the columns."""
    from rich.text import Text

    yield from _row(table, {j: table.headers[j] for j in block}, widths, frozenset())
    yield Text(_GAP.join("─" * widths[j] for j in block))
    for i, row in enumerate(table.cells):
        bold = frozenset(j for j in block if (i, j) in table.bold)
        yield from _row(table, {j: row[j] for j in block}, widths, bold)


def _row(
    table: Table, texts: dict[int, str], widths: dict[int, int], bold: frozenset[int]
) -> Iterator[Text]:
    from rich.text import Text

    parts = {j: broken(text, widths[j]) for j, text in texts.items()}
    for place in range(max(map(len, parts.values()))):
        line = Text(no_wrap=True)
        for number, (j, part) in enumerate(parts.items()):
            text = part[place] if place < len(part) else ""
            text = text.rjust(widths[j]) if table.numeric(j) else text.ljust(widths[j])
            line.append(_GAP if number else "")
            line.append(text, _BOLD if j in bold else "")
        line.rstrip()
        yield line


def _listed(table: Table, width: int) -> Iterator[Text]:
    """Each row as its name and a line a column."""
    from rich.text import Text

    for i, row in enumerate(table.cells):
        yield from (Text(part, "bold") for part in broken(row[0], width))
        for j, header in enumerate(table.headers[1:], start=1):
            inner = max(1, width - len(_INDENT))
            for place, part in enumerate(broken(f"{header}: {row[j]}", inner)):
                indent = _INDENT[: len(_INDENT) - (0 if place else 2)]
                yield Text(indent + part, _BOLD if (i, j) in table.bold else "")
