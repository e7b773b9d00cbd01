"""`slipcar reproduce`."""

from __future__ import annotations

from pathlib import Path

from slipcar.evaluation.commands.checks import check_figures, check_file, check_folder
from slipcar.evaluation.commands.output import Output, OutputOption, finish
from slipcar.evaluation.reproduction.reproduce import EPISODES


def reproduce(
    *,
    episodes: int = EPISODES,
    seed: int = 0,
    folder: Path = Path("results/reproduce"),
    reference: Path | None = None,
    workers: int = 1,
    figures: bool = True,
    docs: Path | None = None,
    output: OutputOption = Output(),  # noqa: B008  frozen
) -> int:
    """Check every claim of the paper's section 6, and show by numbers where its text is wrong.

    Each claim: what the paper says, what we get, a verdict, and the line of Python that gives the
    number again. Then what the text says, what was released with it and what we do, side by side:
    the potential as printed, the clearance, the literal first-order model, the variance penalty,
    the covariance step, the trust region, the terminal box, the start and the stopping rule.
    Writes table.md, .tex, CSV files and figures into the folder. A minute on one core.

        slipcar reproduce
        slipcar reproduce --episodes 1000000 --workers 2

    Calls slipcar.evaluation.reproduction.reproduce.reproduce.

    Args:
        episodes: paths a plan, at least 1. The error of a rate falls as 1/sqrt(episodes).
        seed: of the Brownian paths, at least 0. The same seed gives the same numbers.
        folder: where tables, raw numbers and figures go.
        reference: JSON file with arrays of the paper's case computed elsewhere; by default that
            of the checkout, if this is one.
        workers: processes that share the paths; the numbers do not depend on it.
        figures: draw the figures as well (needs matplotlib).
        docs: also write the page of the documentation, with its figures beside it, to this .md
            file.
        output: what is printed.
    """
    from rich import progress
    from rich.console import Console

    from slipcar.evaluation.reproduction.reproduce import reproduce as compute

    columns = (
        progress.BarColumn(), progress.TaskProgressColumn(), progress.TimeElapsedColumn(),
        progress.TextColumn("left"), progress.TimeRemainingColumn(),
        progress.TextColumn("{task.description}"),
    )  # fmt: skip
    if docs is not None and docs.suffix != ".md":
        raise ValueError(f"--docs must name a .md file, not {str(docs)!r}")
    if docs is not None and not figures:
        raise ValueError("--docs shows the figures: leave --no-figures out")
    check_file(docs)
    check_folder(folder)
    check_figures(figures, "--no-figures")
    with progress.Progress(
        *columns, console=Console(stderr=True), transient=True, disable=output.quiet
    ) as bar:
        task = bar.add_task("", total=1.0)
        done = compute(
            episodes,
            seed,
            reference=reference,
            n_jobs=workers,
            progress=lambda what, share: bar.update(task, completed=share, description=what),
        )
    shown = done.document(figures=False)

    def save() -> list[Path]:
        written = done.save(folder, figures=figures)
        if docs is not None:
            from slipcar.evaluation.reproduction import page as reproduce_page

            written += reproduce_page.save(done, docs, folder)
        return written

    finish(output, save, shown.terminal)
    if output.json:
        print(shown.to_json(), end="")
    return 0
