"""What every command prints, and where: tables on the standard output, the rest on the error."""

from __future__ import annotations

import dataclasses
import json as json_text
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from slipcar.evaluation.report.document import plain
from slipcar.evaluation.report.layout import Prose

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

#: Columns of a pipe or a file, where nobody says how many there are.
_WIDTH = 120


@dataclasses.dataclass(frozen=True)
class Output:
    """What a command prints.

    Attributes:
        quiet: print nothing but what went wrong, and no progress; files are written all the same.
        json: print the numbers as JSON on the standard output, and nothing else there.
    """

    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False

    def console(self) -> Console:
        """Where text for people goes; nowhere if it is not wanted."""
        from rich.console import Console

        return Console(quiet=True) if self.quiet or self.json else console()

    def busy(self, text: str) -> AbstractContextManager[object]:
        """Say on the standard error, while something lasts, what it is."""
        from rich.console import Console

        return Console(stderr=True, quiet=self.quiet).status(text)

    def data(self, value: Any) -> None:
        """Print plain data, where JSON is wanted; nan and infinities are null there."""
        if self.json:
            print(json_text.dumps(plain(value), ensure_ascii=False, allow_nan=False))

    def wrong(self, texts: Iterable[str]) -> None:
        """Say what went wrong, where the tables that would say it are not printed."""
        if self.quiet or self.json:
            for text in texts:
                print(" ".join(text.split()), file=sys.stderr)


#: As the last argument of a command: `--quiet` and `--json`.
OutputOption = Annotated[Output, tyro.conf.arg(name="")]


def console() -> Console:
    """Where tables go: as wide as the terminal, or as COLUMNS says; a pipe is taken to be wide."""
    from rich.console import Console

    out = Console(highlight=False)
    if out.is_terminal or os.environ.get("COLUMNS", "").isdecimal():
        return out
    return Console(highlight=False, width=max(_WIDTH, out.width))


def program() -> str:
    """What to type for this program: in a checkout it need not be where commands are looked for."""
    called = Path(sys.argv[0])
    if called.stem != "slipcar":
        return "python -m slipcar.evaluation"
    known = shutil.which("slipcar")
    same = known is not None and Path(known).resolve() == called.resolve()
    return "slipcar" if same else str(called)


def say(out: Console, text: str) -> None:
    """Print lines that break between words; what a line begins with is set off from what follows.

    A line that begins with blanks and a word of its own column, as a certificate's do, is
    continued below its text.
    """
    for line in text.splitlines():
        label = line[: len(line) - len(line.lstrip())]
        if label:
            head, gap, _ = line.lstrip().partition("  ")
            rest = line[len(label) + len(head) :]
            label = " " * (len(line) - len(rest.lstrip())) if gap else label
        out.print(Prose(line, indent=label))


def say_written(out: Console, written: list[Path]) -> None:
    """Which files there are now."""
    out.print(f"{len(written)} files:", markup=False)
    for path in written:
        out.print(f"  {path}", markup=False, soft_wrap=True)


def finish(
    output: Output,
    save: Callable[[], list[Path]],
    shown: Callable[[], RenderableType],
    notes: Sequence[str] = (),
    more: str = "",
) -> None:
    """Save results, then print them; also where saving fails, say for a figure.

    Args:
        output: what is printed.
        save: writes files and returns them, tables first.
        shown: makes what is printed.
        notes: what readers must be told; part of what is shown, and the rest of it may be unwanted.
        more: where to look for the rest, said once it is there.
    """
    out = output.console()
    try:
        with output.busy("writing tables and drawing figures ..."):
            written = save()
    except BaseException:
        out.print(shown())
        raise
    finally:
        output.wrong(notes)
    out.print(shown())
    if more:
        say(out, more)
    say_written(out, written)
