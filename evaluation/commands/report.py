"""`slipcar report`."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import tyro

from slipcar.evaluation.commands.checks import check_file
from slipcar.evaluation.commands.output import Output, OutputOption, say_written


def report(
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")] = Path(
        "results"
    ),
    *,
    out: Path | None = None,
    open: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    output: OutputOption = Output(),  # noqa: B008  frozen
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
        output: what is printed.
    """
    from slipcar.evaluation.report import folder as report_folder

    said = output.console()
    found = report_folder.find(folder)
    page = folder / "report.html" if out is None else out
    if page.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--out is an HTML file, such as report.html, not {str(page)!r}")
    check_file(page)
    written, notes = report_folder.write(found, page)
    for section in found.sections:
        said.print(f"{section.name}: {section.document.title}", markup=False)
    for problem in (*found.problems, *notes):
        said.print(problem, style="bold red", markup=False, soft_wrap=True)
    say_written(said, written)
    output.wrong((*found.problems, *notes))
    output.data(
        {
            "sections": [section.name for section in found.sections],
            "files": [str(path) for path in written],
            "problems": found.problems,
            "notes": notes,
        }
    )
    if open and not webbrowser.open(page.resolve().as_uri()):
        print(f"slipcar report: no browser could be opened; the page is {page}", file=sys.stderr)
        return 1
    return 1 if found.problems else 0
