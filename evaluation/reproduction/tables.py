"""A reproduction as a document: its tables, its raw numbers, its figures' captions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from slipcar.evaluation.report.document import Document, Figure
from slipcar.evaluation.report.scene import scene
from slipcar.evaluation.report.table import NONE, Table
from slipcar.evaluation.reproduction.claims import NOT_RUN, REPRODUCED, Claim, claims, percent
from slipcar.evaluation.reproduction.discrepancies import Discrepancy, discrepancies
from slipcar.evaluation.reproduction.record import ReproductionRecord
from slipcar.evaluation.reproduction.runs import played, trace_integral
from slipcar.evaluation.reproduction.variants import (
    released_covariance,
    stopping_values,
    text_covariance,
)

TITLE = "The paper, claim by claim"
#: Stem -> caption.
FIGURES = {
    "iterations": "The paper's figure: every iterate, 100 sample paths, velocities and controls.",
    "variants": "Iterates of the paper's literal first-order model, of our convex-composite one, "
    "and with the potential as printed.",
    "covariance": "95 % ellipses and tr Σ: predicted, by the released step, and over the paths.",
    "clearance": "Collision rate against the clearance that is planned for.",
}


#: Plans whose paths a report animates; the iterates are the first's.
ANIMATED = ("ours", "clearance 0.1", "printed potential", "literal")


def document(r: ReproductionRecord, figures: bool) -> Document:
    """Everything, as plain data."""
    told, differing = claims(r), discrepancies(r)
    missing = [claim.name for claim in told if claim.verdict == NOT_RUN]
    return Document(
        kind="reproduce",
        title=TITLE,
        setting=setting(r, told),
        tables=(
            claims_table(told),
            discrepancies_table(differing),
            runs_table(r),
            covariance_table(r),
            *_agreement_table(r),
            _times_table(r),
        ),
        notes=(f"Not run: {', '.join(missing)}.",) if missing else (),
        figures=tuple(Figure(*item) for item in FIGURES.items()) if figures else (),
        frames=frames(r, told, differing),
        provenance=dict(r.provenance),
        scene=scene(_Shown(r)),  # type: ignore[arg-type]
    )


class _Shown:
    """Some of the plans as the rows of a comparison, for the animation of a report."""

    def __init__(self, r: ReproductionRecord) -> None:
        runs = {name: r.runs[name] for name in ANIMATED}
        self.scenario, self.seed, self.substeps, self.reference = r.scenario, r.seed, 1, ANIMATED[0]
        self.controllers = {name: played(run.plan, r.scenario) for name, run in runs.items()}
        self.results = {name: run.result for name, run in runs.items()}


def setting(r: ReproductionRecord, told: Sequence[Claim]) -> str:
    """What was run, and the sum of it."""
    verdicts = [claim.verdict for claim in told]
    counts = ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts))
    return (
        f"Section 6 of Bonalli, Lew and Pavone, Sequential Convex Programming for Non-Linear "
        f"Stochastic Optimal Control: {len(told)} claims, {counts}. Rates over {r.episodes:,} "
        f"paths, seed {r.seed}, the same paths for every plan; Wilson 95 % intervals in brackets."
    )


def claims_table(told: Sequence[Claim]) -> Table:
    """Claim, what it says, what we get, verdict, how."""
    return _texts(
        "Every claim of the paper's §6",
        ("claim", "the paper", "here", "verdict", "the number again, in Python"),
        [(c.name, c.says, c.here, c.verdict, c.how) for c in told],
        bold={(i, 3) for i, c in enumerate(told) if c.verdict != REPRODUCED},
    )


def discrepancies_table(differing: Sequence[Discrepancy]) -> Table:
    """Text, release and this package, by numbers."""
    return _texts(
        "What the paper's text says, what was released with it, and what we do",
        ("", "the text", "released", "here", "the number again, in Python"),
        [(d.name, d.text, d.released, d.here, d.how) for d in differing],
    )


def runs_table(r: ReproductionRecord) -> Table:
    """Every plan, and what its paths do."""
    rows, values = [], []
    for name, run in r.runs.items():
        found, rate = run.plan, run.result.collision_rate
        numbers = (found.iterations, found.effort, found.variance, found.obstacle_cost, rate)
        rows.append(
            (
                name, str(found.status), f"{found.iterations}", f"{found.effort:.4f}",
                f"{found.variance:.5f}", f"{found.obstacle_cost:.4f}", percent(run.result),
            )
        )  # fmt: skip
        values.append((None, None, *map(float, numbers)))
    headers = (
        "plan", "status", "iterations", "effort", "∫ tr Σ dt", "obstacle cost", "collisions"
    )  # fmt: skip
    return Table("The plans behind it", headers, tuple(rows), tuple(values))


def covariances(r: ReproductionRecord) -> dict[str, np.ndarray]:
    """Σ at every node, (N, 5, 5), by step."""
    s, mean = r.scenario, r.runs["ours"].plan.mean
    return {
        "exact step": r.runs["ours"].plan.covariance,
        "the text's step": text_covariance(s, mean),
        "the released step": released_covariance(s, mean),
        f"{r.moments.paths:,} paths": r.moments.covariance,
    }


def covariance_table(r: ReproductionRecord) -> Table:
    """∫ tr Σ dt and the deviations at the end, by step."""
    rows, values = [], []
    for name, covariance in covariances(r).items():
        numbers = _spread(r, covariance)
        measured = r.moments.variance[0]
        ratio = numbers[0] / measured if measured > 0.0 else math.nan  # a single path has none
        texts = (f"{numbers[0]:.5f}", f"{ratio:.3f}", *(f"{value:.4f}" for value in numbers[1:]))
        rows.append((name, *texts))
        values.append((None, numbers[0], ratio, *numbers[1:]))
    headers = ("covariance", "∫ tr Σ dt", "of the paths'", "r_x(T) [m]", "r_y(T) [m]", "θ(T) [rad]")
    caption = (
        "Our plan's covariance by each step: integral, and standard deviations at the end "
        f"(standard error of the paths' integral: {r.moments.variance[1]:.5f})"
    )
    return Table(caption, headers, tuple(rows), tuple(values))


def _spread(r: ReproductionRecord, covariance: np.ndarray) -> tuple[float, ...]:
    deviations = np.sqrt(np.maximum(np.diagonal(covariance[-1])[:3], 0.0))
    return trace_integral(covariance, r.scenario.dt), *map(float, deviations)


def _agreement_table(r: ReproductionRecord) -> tuple[Table, ...]:
    if not r.agreement:
        return ()
    rows, values = [], []
    for part, a in r.agreement.items():
        rate, error = a.rate
        rows.append(
            (
                part, f"{a.controls:.1e}", f"{a.states:.1e}", f"{a.effort:+.1e}",
                f"{100 * rate:.2f} ± {100 * error:.2f} %", a.source,
            )
        )  # fmt: skip
        values.append((None, a.controls, a.states, a.effort, rate, None))
    headers = (
        "reference", "largest difference of a control", "of a state", "of the effort, relative",
        "collisions measured there", "how it was computed",
    )  # fmt: skip
    caption = "Our plans (w = 0, to the last digit) beside arrays computed elsewhere"
    return (Table(caption, headers, tuple(rows), tuple(values)),)


def _times_table(r: ReproductionRecord) -> Table:
    rows, values = [], []
    for solver, told in r.solvers.items():
        seconds = told.get("seconds")
        difference = told.get("difference")
        rows.append(
            (
                solver,
                NONE if seconds is None else f"{1000 * seconds:.2g}",
                NONE if difference is None else f"{difference:.0e}",
                str(told.get("iterations", NONE)),
            )
        )
        values.append((None, seconds, difference, _number(told.get("iterations"))))
    headers = ("solver of the sub-problems", "whole plan [ms]", "controls differ by", "iterations")
    return Table(
        "Times, which differ from run to run (the least of some)", headers,
        tuple(rows), tuple(values),
    )  # fmt: skip


def _number(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _texts(
    caption: str,
    headers: tuple[str, ...],
    rows: Sequence[tuple[str, ...]],
    bold: set[tuple[int, int]] | None = None,
) -> Table:
    nothing = tuple((None,) * len(headers) for _ in rows)
    return Table(caption, headers, tuple(rows), nothing, frozenset(bold or ()))


def frames(
    r: ReproductionRecord, told: Sequence[Claim], differing: Sequence[Discrepancy]
) -> dict[str, pd.DataFrame]:
    """Raw numbers by name; `times` alone differs from run to run."""
    runs = {
        name: {
            "status": str(run.plan.status),
            "iterations": run.plan.iterations,
            "effort": run.plan.effort,
            "obstacle_cost": run.plan.obstacle_cost,
            "variance": run.plan.variance,
            "clear_iterates": run.clear,
            **_rates(run.result),
        }
        for name, run in r.runs.items()
    }
    ours = r.runs["ours"].plan
    iterations = {
        i + 1: {
            "stopping_value": squared,
            "stopping_value_released": not_squared,
            "effort": iterate.effort,
            "obstacle_cost": iterate.penalty,
            "variance": iterate.variance,
            "trust_radius": iterate.trust_radius,
        }
        for i, (iterate, squared, not_squared) in enumerate(
            zip(
                ours.history, stopping_values(ours), stopping_values(ours, squared=False),
                strict=True,
            )
        )
    }  # fmt: skip
    covariance = {
        name: dict(zip(("variance", "r_x", "r_y", "theta"), _spread(r, each), strict=True))
        for name, each in covariances(r).items()
    }
    agreement = {
        part: {"controls": a.controls, "states": a.states, "effort": a.effort, "rate": a.rate[0]}
        for part, a in r.agreement.items()
    }
    times = {name: {"seconds": each.get("seconds", math.nan)} for name, each in r.solvers.items()}
    sweep = {clearance: _rates(result) for clearance, result in r.sweep.items()}
    tables: dict[str, tuple[str, dict[Any, dict[str, Any]]]] = {
        "table": ("claim", {c.name: _claim(c) for c in told}),
        "discrepancies": ("what", {d.name: _discrepancy(d) for d in differing}),
        "runs": ("plan", runs),
        "iterations": ("iteration", iterations),
        "covariance": ("covariance", covariance),
        "clearance": ("clearance", sweep),
        "agreement": ("reference", agreement),
        "times": ("solver", times),
    }
    return {
        name: pd.DataFrame.from_dict(rows, orient="index").rename_axis(index)
        for name, (index, rows) in tables.items()
        if rows
    }


def _rates(result: Any) -> dict[str, float]:
    low, high = result.collision_interval
    return {
        "episodes": result.episodes,
        "collision_rate": result.collision_rate,
        "collision_low": low,
        "collision_high": high,
    }


def _claim(c: Claim) -> dict[str, Any]:
    value = math.nan if c.value is None else c.value
    return {
        "paper": c.says, "here": c.here, "verdict": c.verdict, "value": value, "how": c.how
    }  # fmt: skip


def _discrepancy(d: Discrepancy) -> dict[str, Any]:
    return {
        "text": d.text, "released": d.released, "here": d.here, "value": d.value, "how": d.how
    }  # fmt: skip
