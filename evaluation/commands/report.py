"""`slipcar report`."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import tyro

from slipcar.evaluation.commands.inputs import console


def report(
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")] = Path(
        "results"
    ),
    *,
    out: Path | None = None,
    open: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> int:
    """Gather all results of a folder in one page, and in files for papers and spreadsheets.

    Reads every document.json in the folder and below, which the other commands write, and writes
    report.html: one file that needs no network, with tables that sort, figures that zoom,
    iterates and paths that move, and where every number comes from. Beside it the same tables as
    report.md and report.tex (booktabs), and the raw numbers as CSV and Parquet in report-data.

        slipcar report results
        slipcar report results/compare --out page.html --open

    Calls slipcar.evaluation.report.folder.find and write.

    Args:
        folder: with results, such as results/compare, or above such folders.
        out: the page; report.html in the folder by default.
        open: show it in the browser.
    """
    from slipcar.evaluation.report import folder as report_folder

    said = console()
    found = report_folder.find(folder)
    page = folder / "report.html" if out is None else out
    if page.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--out is an HTML file, such as report.html, not {str(page)!r}")
    written, notes = report_folder.write(found, page)
    for section in found.sections:
        said.print(f"{section.name}: {section.document.title}", markup=False)
    for problem in (*found.problems, *notes):
        said.print(problem, style="bold red", markup=False, soft_wrap=True)
    said.print(f"{len(written)} files:", markup=False)
    for path in written:
        said.print(f"  {path}", markup=False, soft_wrap=True)
    if open:
        webbrowser.open(page.resolve().as_uri())
    return 1 if found.problems else 0
