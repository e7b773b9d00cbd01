"""Held-out random worlds: does it work elsewhere than where it was tuned?

Planners plan each world; the policies were trained on worlds of the same family, and see the
obstacles, but never saw these. Worlds are the sampling unit: every number is a mean over worlds,
and its interval says how far another hundred worlds would differ.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.families import Family
from slipcar.evaluation.learned import learned_rows
from slipcar.evaluation.makers import Maker
from slipcar.evaluation.report.document import Document, Figure
from slipcar.evaluation.report.formats import with_error, with_interval
from slipcar.evaluation.report.table import Column, table_of
from slipcar.evaluation.statistics import bca_interval, leader, standard_error, wilson_interval
from slipcar.evaluation.suites.records import Suite, SuiteResult, Variant

if TYPE_CHECKING:
    import pandas as pd

#: The family whose policies are shipped, and what its worlds are called.
FAMILY = "random"
EPISODES, WORLDS = 512, 100
REFERENCE = "stochastic SCP + feedback"
#: Columns that only rows have that met the reference somewhere; nan in others.
_TO_REFERENCE = (
    *("total_difference", "total_difference_low", "total_difference_high"),
    *("collision_difference", "collision_difference_low", "collision_difference_high", "cheaper"),
)


def suite(episodes: int = EPISODES, worlds: int = WORLDS) -> Suite:
    """100 held-out worlds of the family of random ones.

    Args:
        episodes: of each row in each world, >= 1.
        worlds: the first so many of the 100, >= 1.

    Raises:
        ValueError: for more worlds than there are.
    """
    rows: dict[str, Any] = {
        "straight (ignores obstacles)": Maker.of("straight"),
        "deterministic SCP": Maker.of("deterministic"),
        "stochastic SCP": Maker.of("stochastic"),
        REFERENCE: Maker.of("feedback"),
        "planned feedback": Maker.of("planned-feedback"),
        "planned feedback, 8 starts": Maker.of("planned-feedback", starts=8),
        "planned feedback, risk ≤ 1 %": Maker.of("planned-feedback", risk=0.01),
        "receding horizon": Maker.of("receding"),
        **learned_rows(FAMILY),
    }
    held_out = Family.named(FAMILY).held_out(worlds)
    variants = [
        Variant(f"world {number}", float(number), scenario)
        for number, scenario in enumerate(held_out)
    ]
    return Suite("random", rows, variants, episodes, REFERENCE)


def document(result: SuiteResult) -> Document:
    """Tables over worlds, and what they were made of."""
    frame = over_worlds(result)
    worlds = len(result.suite.variants)
    shown = frame.assign(
        total_best=_winner(result, frame, "total"),
        collision_best=_winner(result, frame, "collision_rate"),
    )
    tables = (
        table_of(
            shown,
            f"Over {worlds} held-out worlds: in how many the row finished, its means of those "
            "worlds' means ± standard error over worlds; median world; share of worlds whose plan "
            "failed",
            _COST,
        ),
        table_of(
            shown,
            "Collisions: mean over worlds (BCa bootstrap 95 % interval over worlds, at least as "
            "wide as Wilson's of all their episodes), worst world",
            _COLLISIONS,
        ),
        table_of(
            shown,
            f"Paired difference to “{result.suite.reference}” in the same worlds on the same "
            "Brownian paths (BCa bootstrap 95 % interval over worlds), and in how many it is "
            "cheaper",
            _DIFFERENCES,
        ),
    )
    from slipcar.evaluation.suites.shared import frames, notes

    return Document(
        kind="suite-random",
        title="Held-out random worlds",
        setting=(
            f"{worlds} worlds of the family “{FAMILY}” that nothing was trained or tuned on, "
            f"{result.suite.episodes:,} episodes of each row in each, seed {result.seed}. Planners "
            "plan for each world; policies were trained on other worlds of the family."
        ),
        tables=tables,
        notes=notes(result),
        figures=(
            Figure(
                "random",
                "Each line: the worlds, sorted. Left: cost, relative to the reference row in the "
                "same world. Right: collision rate.",
            ),
        ),
        frames={"table": frame, **frames(result)},
        provenance=result.provenance,
    )


def _winner(result: SuiteResult, frame: pd.DataFrame, metric: str) -> list[bool]:
    """Which row has the least mean over worlds, beyond the interval of each paired difference.

    Who gave up the hard worlds is no rival of those who drove them.
    """
    if metric not in result.frame:  # every row raised
        return [False] * len(frame)
    cells = result.frame.pivot(index="variant", columns="controller", values=metric)
    everywhere = frame.index[frame["worlds"] == frame["worlds"].max()]
    found = leader(
        {name: float(cells[name].mean()) for name in everywhere},
        lambda name, best: bca_interval((cells[name] - cells[best]).dropna().to_numpy(dtype=float)),
    )
    return [found is not None and name == found.winner for name in frame.index]


def over_worlds(result: SuiteResult) -> pd.DataFrame:
    """One line a row: aggregates over worlds."""
    import pandas as pd

    lines = {}
    whole = result.frame
    base = whole[whole["controller"] == result.suite.reference].set_index("variant")
    for row in result.suite.rows:
        mine = whole[whole["controller"] == row].set_index("variant")
        finished = mine[mine["error"] == ""]
        line: dict[str, Any] = {"worlds": len(finished), "error": ""}
        line |= dict.fromkeys(_TO_REFERENCE, float("nan"))
        if len(finished) == 0:
            line["error"] = str(mine["error"].iloc[0])
        else:
            totals = finished["total"].to_numpy(dtype=float)
            rates = finished["collision_rate"].to_numpy(dtype=float)
            line |= {
                "closed_loop": bool(finished["closed_loop"].iloc[0]),
                "runs": int(finished["runs"].iloc[0]),
                "total": totals.mean(),
                "total_se": standard_error(totals),
                "total_median": float(np.median(totals)),
                "effort": float(finished["effort"].mean()),
                "failed": float((finished["failures"] > 0).mean()),
                **_collisions(rates, finished["episodes"].to_numpy(dtype=float)),
                "collision_worst": rates.max(),
                "collision_free": float((rates == 0.0).mean()),
                "between_rate": float(finished["between_rate"].mean()),
            }
            if row != result.suite.reference:
                common = [label for label in finished.index if base["error"].get(label) == ""]
                paired = finished.loc[common], base.loc[common]
                for metric in ("total", "collision_rate"):
                    difference = (paired[0][metric] - paired[1][metric]).to_numpy(dtype=float)
                    name = f"{metric.removesuffix('_rate')}_difference"
                    if len(difference):
                        found = bca_interval(difference)
                        line |= {name: found.mean, f"{name}_low": found.low}
                        line[f"{name}_high"] = found.high
                        if metric == "total":
                            line["cheaper"] = float((difference < 0.0).mean())
        lines[row] = line
    last = (*_TO_REFERENCE, "error")
    columns = list(dict.fromkeys(key for line in lines.values() for key in line if key not in last))
    frame = pd.DataFrame.from_dict(lines, orient="index", columns=[*columns, *last])
    return frame.rename_axis("controller")


def _collisions(rates: np.ndarray, episodes: np.ndarray) -> dict[str, float]:
    """Mean over worlds, with an interval over worlds that has a width also where no path collides.

    What worlds differ by says nothing where all rates are 0; how few their episodes are still does.
    """
    mean, low, high = bca_interval(rates)
    pooled = wilson_interval(float(rates @ episodes), int(episodes.sum()))
    return {
        "collision_rate": mean,
        "collision_low": float(np.minimum(low, pooled[0])),  # nan for a single world
        "collision_high": float(np.maximum(high, pooled[1])),
    }


def _percent(key: str, digits: int = 2) -> Any:
    return lambda row: f"{100.0 * row[key]:.{digits}f}"


_LOOP = Column("loop", lambda row: "closed" if row["closed_loop"] else "open")
_COST = (
    _LOOP,
    Column("worlds", lambda row: f"{int(row['worlds'])}", value="worlds"),
    Column("total cost", with_error("total", 2), "total", "total_best"),
    Column("median world", lambda row: f"{row['total_median']:.2f}", "total_median"),
    Column("effort", lambda row: f"{row['effort']:.2f}", value="effort"),
    Column("plans failed [% of worlds]", _percent("failed", 0), value="failed"),
)
_COLLISIONS = (
    _LOOP,
    Column(
        "collisions [%]",
        with_interval("collision_rate", "collision", 100, 2),
        "collision_rate",
        "collision_best",
    ),
    Column("at or between nodes [%]", _percent("between_rate"), "between_rate"),
    Column("worst world [%]", _percent("collision_worst", 1), "collision_worst"),
    Column("worlds without any [%]", _percent("collision_free", 0), "collision_free"),
)
_DIFFERENCES = (
    _LOOP,
    Column(
        "Δ total cost",
        with_interval("total_difference", "total_difference", 1.0, 3, "+"),
        value="total_difference",
    ),
    Column("cheaper in [% of worlds]", _percent("cheaper", 0), value="cheaper"),
    Column(
        "Δ collisions [% points]",
        with_interval("collision_difference", "collision_difference", 100.0, 2, "+"),
        value="collision_difference",
    ),
)
