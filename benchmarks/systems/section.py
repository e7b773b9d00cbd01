"""The three measurements as a part of the benchmarks' pages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from report import Section

ABOUT = """\
Eleven systems as users write them from [planner.md](planner.md) alone, in plain NumPy without a
Jacobian ([benchmarks/systems](../benchmarks/systems)), and variants: `FallingArm` starts from the
uncontrolled path, `FreeFlyerMm` is in millimetres, `Upright` holds an inverted pendulum for 10 s.
The peer is CasADi + IPOPT on the same Euler steps and costs, a programme of scalars (`expand`) made
from our own trace, multiple shooting, MUMPS, tolerance 1e-9, built once.

* **The default call**: `plan(problem, variance_weight=0.0)` from the problem's own guess, at the
  default tolerance; IPOPT starts there, too. The two take turns; the fastest of each are compared.
  *miss* is the largest violation of an Euler step, of the terminal condition or of a bound, each
  component in parts of its largest value. *good* is converged to a miss of 1e-4, certified
  (`p.certificate.extremal`) and at most 1 % dearer than IPOPT; a cheaper plan went another way.
* **Disturbed guesses**: on each state a half and a whole sine wave of up to 0.3 of its range along
  the guess, noise of 0.2 of their range on controls, seeds 0 to 19; ours with
  `cold_start="never"`, so that no other guess helps. *Within 1 %* is of the best plan that anybody
  found from any guess. IPOPT's answers are kept on disk, and their times with them.
* **Other units**: lengths in mm and km (concentrations, for the reactor), controls in thousands,
  time in µs, another unit of cost; all else converted. *same* is the same status, the same
  iterations and the same plan to 1e-9.
"""

TITLES = {"default": "The default call", "guesses": "Disturbed guesses", "units": "Other units"}
#: Cells that are too long for a page.
_LONG = ("failed",)


def section(folder: Path) -> Section:
    """All of it, to be printed and kept; IPOPT's answers are remembered in the folder."""
    # CasADi is imported when it is needed: other parts run without.
    from . import measure_default, measure_guesses, measure_units
    from .catalogue import IN_UNITS, SYSTEMS
    from .table import printed

    rows: dict[str, list[dict[str, Any]]] = {}
    notes: list[str] = []
    names = list(SYSTEMS)
    for what, records, summary in (
        ("default", measure_default.measure(names), measure_default.summary),
        ("guesses", measure_guesses.measure(names, folder / "systems-ipopt"),
         measure_guesses.summary),
        ("units", measure_units.measure(IN_UNITS), measure_units.summary),
    ):  # fmt: skip
        found: list[Any] = list(printed(records))
        rows[what] = [record.row() for record in found]
        notes += [f"{TITLES[what]}: {line}" for line in summary(found)]
    shown = {
        TITLES[what]: [{k: v for k, v in row.items() if k not in _LONG} for row in table]
        for what, table in rows.items()
    }
    return Section(
        part="systems",
        title="Users' systems",
        about=ABOUT,
        tables=shown,
        notes=tuple(notes),
        raw=rows,
    )
