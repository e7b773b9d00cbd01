"""Write docs/suites.md and its pictures from what `make suites` left in results/.

make suites && python benchmarks/suites_page.py
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from slipcar.evaluation.report.document import Document, read_document
from slipcar.evaluation.report.text import machine, markdown_table

SUITES = ("random", "slip", "horizon")
HEAD = """# Suites

What the suites of `slipcar compare` found; [comparison.md](comparison.md) says what the numbers
mean. Made by `make suites` and `python benchmarks/suites_page.py`: nothing here is typed by hand.
"""


def section(name: str, document: Document, docs: Path, folder: Path) -> str:
    parts = [f"## {document.title}", f"`slipcar compare --suite {name}`. {document.setting}"]
    for figure in document.figures:
        picture = f"suite-{figure.stem}.png"
        shutil.copyfile(folder / f"{figure.stem}.png", docs / picture)
        parts.append(f"![{figure.caption}]({picture})")
    for table in document.tables:
        parts += [f"**{table.caption}**", markdown_table(table)]
    parts += [*document.notes, f"Computed on {machine(document.provenance)}"]
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    options = parser.parse_args()
    parts = [HEAD.strip()]
    for name in SUITES:
        folder = options.results / name
        parts.append(section(name, read_document(folder), options.docs, folder))
    (options.docs / "suites.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
