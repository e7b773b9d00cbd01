"""Pages of docs/ from what the parts left behind: nothing in them is written by hand."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import report

DOCS = Path(__file__).resolve().parent.parent / "docs"
_PREFIX = "bench-"

_HOW = """\
One process, one core (`OMP_NUM_THREADS=1`). Contenders take turns, in an order drawn anew each
round, so that a busy machine is busy for all of them; the first call of each is not counted, and
a short call follows an uncounted one of its own. Tables show the median, the quartiles and the
fastest of the rounds. What is built once beforehand (a programme in CasADi or cvxpy) stands in a
column of its own and is not in the time. A time of slipcar's is the whole call of `plan` on a
problem that it has met before: guess, iterations, covariance, multipliers, and the `Plan` itself
(a problem that it has not met is checked and traced first: a table of its own shows that; what is
compiled for a kind of problems, once, is in the tables of cold starts). A time of CasADi's is the
call of its solver. Whatever a contender believes of its answer, its controls are driven through
slipcar's own dynamics, and the cost and the miss of the goal are those of that path. Milliseconds
belong to the machine; what carries over are ratios within a run."""
_HOW_ENVIRONMENT = """\
One process, pinned to one core where the system allows it (`OMP_NUM_THREADS=1`). What is compared
is stepped by turns, in an order drawn anew each round, so that a busy machine is busy for all; a
first turn is not counted. Steps per second belong to the machine; what carries over are ratios
within a run."""
_HOW_SYSTEMS = """\
One process, one core (`OMP_NUM_THREADS=1`). A time of slipcar's is the whole call of `plan` on a
problem that it has met before, a time of CasADi's the call of its solver on a programme that is
built. What either believes of its answer is judged by the problem's own functions. Milliseconds
belong to the machine; what carries over are ratios within a run."""
_HOW_LIVE = """\
The server, the browser and what drags share the machine's cores, and whatever else runs has its
share; what is timed is said at each table. Milliseconds belong to the machine."""
#: By page; `_HOW` elsewhere.
_HOW_OF = {
    "benchmarks-environment.md": _HOW_ENVIRONMENT,
    "benchmarks-systems.md": _HOW_SYSTEMS,
    "benchmarks-live.md": _HOW_LIVE,
}


def write(
    folder: Path,
    parts: Sequence[str],
    docs: Path = DOCS,
    *,
    name: str = "benchmarks.md",
    title: str = "Benchmarks",
) -> list[Path]:
    """Write a page and its figures; returns their paths.

    Args:
        folder: where the parts have been measured into.
        parts: names of the sections, in order.
        docs: where the page goes.
        name: of its file.
        title: its heading.

    Raises:
        FileNotFoundError: if a part or a figure is missing in the folder.
        ValueError: if the parts were measured on different machines or versions.
    """
    sections = [report.load(folder, part) for part in parts]
    first = sections[0][1]
    for section, told in sections:
        if _place(told) != _place(first):
            raise ValueError(
                f"{section.part} was measured on another machine or with other versions than "
                f"{sections[0][0].part}: {report.machine(told)} Measure all parts again."
            )
    how = "How times are taken"
    contents = [how, *(section.title for section, _ in sections)]
    lines = [
        f"# {title}",
        "",
        "Written by `make bench-docs`; do not edit.",
        "",
        *(f"* [{part}](#{anchor(part)})" for part in contents),
        "",
        report.machine(first),
        "",
        f"## {how}",
        "",
        _HOW_OF.get(name, _HOW),
        "",
        *(report.markdown(section, told, _PREFIX) for section, told in sections),
    ]
    docs.mkdir(parents=True, exist_ok=True)
    paths = []
    for section, _ in sections:
        for figure in section.figures:
            paths.append(docs / f"{_PREFIX}{figure}.png")
            shutil.copyfile(folder / f"{figure}.png", paths[-1])
    page = docs / name
    page.write_text("\n".join(lines), encoding="utf-8")
    return [page, *paths]


def anchor(title: str) -> str:
    """What a heading is called in a link, on GitHub and in most other renderers."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def _place(told: dict[str, Any]) -> tuple[Any, ...]:
    return told["cpu"], told["python"], told["versions"]
