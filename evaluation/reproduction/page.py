"""The page of the documentation: written by `slipcar reproduce --docs`, no number by hand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from slipcar.baselines.files import write_atomically
from slipcar.evaluation.report.text import machine, markdown_table
from slipcar.evaluation.reproduction.claims import PREAMBLE
from slipcar.evaluation.reproduction.tables import FIGURES, TITLE

if TYPE_CHECKING:
    from slipcar.evaluation.report.document import Document
    from slipcar.evaluation.reproduction.reproduce import Reproduction

_HEAD = """\
# {title}

Every number on this page was computed by the command that wrote it:

```sh
slipcar reproduce                                     # a minute on one core
slipcar reproduce --docs docs/reproduction.md         # and this page
```

{setting}

*Reproduced*: what the paper says is what we get. *Not as printed*: the paper's result is
reproduced by something else than its text, which the second table takes apart. *Differs*: we get,
or do, something else. *Not run*: what it takes is not here. The lines of Python go on from these:

```python
{preamble}
```
"""
_BETWEEN = """\
## Where the text and what was released differ

The released experiment is StanfordASL/stochasticSCP. Its code was read, not run; what it does
differently was written anew
([reproduction/variants.py](../evaluation/reproduction/variants.py)) and measured on the same paths.
"""


def page(document: Document, images: dict[str, str]) -> str:
    """The page's text.

    Args:
        document: of a reproduction.
        images: stem of a figure -> the file to show.
    """
    told, differing, *rest = document.tables
    shown = {stem: f"![{FIGURES[stem]}]({file})" for stem, file in images.items()}
    parts = [
        _HEAD.format(title=TITLE, setting=document.setting, preamble=PREAMBLE),
        "## The claims",
        markdown_table(told),
        shown["iterations"],
        _BETWEEN,
        markdown_table(differing),
        *(shown[stem] for stem in ("variants", "covariance", "clearance")),
        "## The numbers behind both",
    ]
    for table in rest:
        parts += [f"**{table.caption}**", markdown_table(table)]
    parts += [*document.notes, f"Computed on {machine(document.provenance)}"]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def save(r: Reproduction, path: Path, figures: Path) -> list[Path]:
    """Write the page and, beside it, its figures.

    Args:
        r: what was computed.
        path: of the page.
        figures: the folder that :meth:`Reproduction.save` drew into.

    Returns:
        The files.
    """
    images = {stem: f"{path.stem}-{stem}.png" for stem in FIGURES}
    path.parent.mkdir(parents=True, exist_ok=True)
    for stem, name in images.items():
        write_atomically(path.parent / name, (figures / f"{stem}.png").read_bytes())
    write_atomically(path, page(r.document(), images).encode())
    return [path, *(path.parent / name for name in images.values())]
