"""A document for a terminal, as Markdown and as LaTeX."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Protocol

from slipcar.evaluation.report.layout import Fitted, Prose
from slipcar.evaluation.report.table import Table

if TYPE_CHECKING:
    from rich.console import Group


class Printed(Protocol):
    """What is printed of a :class:`slipcar.evaluation.report.document.Document`."""

    @property
    def setting(self) -> str:
        """A sentence or two on what was run."""
        ...

    @property
    def tables(self) -> tuple[Table, ...]:
        """In order."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader must be told."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Versions, machine, date, commit."""
        ...


def machine(provenance: Mapping[str, Any]) -> str:
    """A sentence on where numbers were computed; says what it is told and no more."""
    parts = [str(provenance["cpu"])] if provenance.get("cpu") else []
    if provenance.get("python"):
        parts.append(f"Python {provenance['python']}")
    parts += [f"{name} {version}" for name, version in (provenance.get("versions") or {}).items()]
    if provenance.get("commit"):
        parts.append(f"commit {provenance['commit'][:12]}")
    if provenance.get("date"):
        parts.append(str(provenance["date"]))
    return ", ".join(parts) + "." if parts else ""


def markdown(document: Printed) -> str:
    """Tables in Markdown with their captions, notes and provenance."""
    parts = [prose(document.setting)] if document.setting else []
    for table in document.tables:
        parts += [f"**{prose(table.caption)}**", markdown_table(table)]
    parts += [prose(note) for note in document.notes]
    if told := machine(document.provenance):
        parts.append(f"Computed on {told}")
    return "\n\n".join(parts) + "\n"


def markdown_table(table: Table) -> str:
    """A table in Markdown (GitHub's), without its caption."""
    from tabulate import tabulate

    rows = [
        [
            f"**{_markdown(text)}**" if (i, j) in table.bold else _markdown(text)
            for j, text in enumerate(row)
        ]
        for i, row in enumerate(table.cells)
    ]
    headers = [_markdown(header) for header in table.headers]
    return tabulate(rows, headers, tablefmt="github", disable_numparse=True)


def csv_table(table: Table) -> str:
    """A table as CSV, as it is printed; raw numbers are in the frames."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([table.headers, *table.cells])
    return text.getvalue()


def prose(text: str) -> str:
    """One paragraph in Markdown: it begins no heading, list or table, names in it no tag."""
    line = re.sub(r"<(?=[A-Za-z/!?])", r"\<", " ".join(text.split()))
    line = re.sub(r"^(?=[#>|=~+-])", r"\\", line)
    return re.sub(r"^(\d+)(?=[.)](?: |$))", r"\1\\", line)


def _markdown(text: str) -> str:
    """What would end a cell, or begin a tag, a link or emphasis, is escaped.

    An underscore within or behind a word begins no emphasis, a bracket that no parenthesis follows
    no link: they stay as they are.
    """
    special = r"[\\|<*`~]|(?<!\w)_+|\](?=\()|&(?=#?\w+;)"
    line = " ".join(text.split())
    return re.sub(special, lambda found: "".join(rf"\{letter}" for letter in found[0]), line)


def latex(document: Printed) -> str:
    r"""Floating tables in LaTeX; they need `\usepackage{booktabs}`."""
    remarks = [document.setting, machine(document.provenance), *document.notes]
    parts = [f"% {' '.join(remark.split())}" for remark in remarks if remark]
    return "\n".join([*parts, *(latex_table(table) for table in document.tables)])


def latex_table(table: Table) -> str:
    """A floating table in LaTeX."""
    import pandas as pd

    rows = [
        [
            rf"\textbf{{{tex(text)}}}" if (i, j) in table.bold else tex(text)
            for j, text in enumerate(row)
        ]
        for i, row in enumerate(table.cells)
    ]
    escaped = pd.DataFrame(rows, columns=range(len(table.headers)))
    escaped.columns = pd.Index([tex(header) for header in table.headers])
    return escaped.to_latex(
        index=False,
        escape=False,
        caption=tex(table.caption) + ".",
        column_format="".join("r" if table.numeric(j) else "l" for j in range(len(table.headers))),
        position="htb",
    )


_GREEK = (
    "alpha beta gamma delta varepsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau "
    "upsilon varphi chi psi omega Gamma Delta Theta Lambda Xi Pi Sigma Phi Psi Omega"
)
_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "$": r"\$",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"$<$", ">": r"$>$", "|": r"$|$", "\n": " ", "\r": " ", "\t": " ",
    "±": r"$\pm$", "µ": r"\textmu{}", "≤": r"$\leq$", "≥": r"$\geq$", "×": r"$\times$",
    "−": r"$-$", "·": r"$\cdot$", "→": r"$\to$", "≈": r"$\approx$", "∞": r"$\infty$",
    "∫": r"$\int$", "√": r"$\surd$", "‖": r"$\|$", "∈": r"$\in$", "≠": r"$\neq$", "°": r"$^\circ$",
    "“": "``", "”": "\'\'", "„": r"\quotedblbase{}", "’": "'", "–": "--", "—": "---",
    "…": r"\ldots{}", "\u00a0": "~", "\u202f": r"\,", "\u2009": r"\,",
    **dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹", (f"$^{i}$" for i in range(10)), strict=True)), "⁻": "$^-$",
    **dict(zip("₀₁₂₃₄₅₆₇₈₉", (f"$_{i}$" for i in range(10)), strict=True)),
    **{
        letter: f"$\\{name}$"
        for letter, name in zip("αβγδεζηθικλμνξπρστυφχψωΓΔΘΛΞΠΣΦΨΩ", _GREEK.split(), strict=True)
    },
}  # fmt: skip


def tex(text: str) -> str:
    """Text with what LaTeX would take as commands escaped."""
    return "".join(_TEX.get(letter, letter) for letter in text)


def html_table(table: Table) -> str:
    """A table in HTML, without script and with no style but its own; all of it is escaped."""
    align = ["right" if table.numeric(j) else "left" for j in range(len(table.headers))]

    def cell(i: int, j: int, text: str) -> str:
        shown = f"<strong>{escape(text)}</strong>" if (i, j) in table.bold else escape(text)
        kind = 'th scope="row"' if j == 0 else "td"
        style = f'style="text-align:{align[j]};white-space:nowrap"'
        return f"<{kind} {style}>{shown}</{kind[:2]}>"

    head = "".join(
        f'<th scope="col" style="text-align:{side}">{escape(header)}</th>'
        for side, header in zip(align, table.headers, strict=True)
    )
    rows = "".join(
        f"<tr>{''.join(cell(i, j, text) for j, text in enumerate(row))}</tr>"
        for i, row in enumerate(table.cells)
    )
    return (
        f'<table><caption style="text-align:left">{escape(table.caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    )


def terminal(document: Printed, tables: int | None = None, sentences: Sequence[str] = ()) -> Group:
    """Tables for a terminal, to be printed by a rich console, which they fit.

    Args:
        document: what is printed.
        tables: only the first so many; None prints all.
        sentences: what the tables say, below them.
    """
    from rich.console import Group
    from rich.text import Text

    parts: list[Any] = [Prose(document.setting), Text()]
    for table in document.tables[:tables]:
        parts += [Prose(table.caption, "bold"), Fitted(table), Text()]
    parts += map(Prose, sentences)
    parts += [Prose(note, "bold red") for note in document.notes]
    return Group(*parts)
