"""How fine a grid: plans with few and with many nodes, driven where time hardly has steps.

A plan is exact on its own grid, an Euler scheme with N nodes; the car it is meant for is not. The
same plan is therefore driven twice: on its own grid, as the paper does, and with so many substeps
that all variants are simulated with the same, fine step. What differs is the discretisation error
of the plan (in its mean and in its covariance), and, for collisions, of the check at nodes alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.learned import learned_rows
from slipcar.evaluation.makers import Maker
from slipcar.evaluation.report.document import Document, Figure
from slipcar.evaluation.report.table import Column, table_of
from slipcar.evaluation.suites.records import Suite, SuiteResult, Variant
from slipcar.evaluation.suites.shared import frames, notes

if TYPE_CHECKING:
    import pandas as pd

#: Nodes of the plan; and steps of the fine simulation, a multiple of all numbers of intervals.
NODES = (11, 21, 41, 81, 161)
FINE = 640
EPISODES = 4096
REFERENCE = "stochastic SCP"


def suite(episodes: int = EPISODES, nodes: tuple[int, ...] = NODES) -> Suite:
    """The paper's scenario with other numbers of nodes, on the plan's own grid and a fine one.

    Args:
        episodes: of each row in each variant, >= 1.
        nodes: numbers of nodes; each less one must divide :data:`FINE`.

    Raises:
        ValueError: for a number that does not.
    """
    for count in nodes:
        if count < 2 or FINE % (count - 1):
            raise ValueError(f"nodes: {count} - 1 must be a divisor of {FINE}")
    rows: dict[str, Any] = {
        REFERENCE: Maker.of("stochastic"),
        "stochastic SCP, RK4 mean": Maker.of("stochastic", integrator="rk4"),
        "stochastic SCP + feedback": Maker.of("feedback"),
        "planned feedback": Maker.of("planned-feedback"),
        **learned_rows("paper", ("ppo",)),
    }
    paper = Scenario.named("paper")
    variants = []
    for count in sorted(nodes):
        world = paper.replace(nodes=count)
        variants.append(Variant(f"N = {count}, own grid", float(count), world))
        substeps = FINE // (count - 1)
        variants.append(Variant(f"N = {count}, fine", float(count), world, substeps))
    return Suite("horizon", rows, variants, episodes, REFERENCE)


def document(result: SuiteResult) -> Document:
    """Own grid against the fine simulation, for each number of nodes."""
    frame = grids(result)
    counts = sorted({int(variant.value) for variant in result.suite.variants})
    tables = []
    for caption, metric, form, scale in (
        ("Mean cost of a path", "total", "{:.3f}", 1.0),
        ("Position error at the goal, RMS [m]", "position_rms", "{:.4f}", 1.0),
        ("Collisions at nodes [%]", "collision_rate", "{:.2f}", 100.0),
        ("Collisions at or between nodes [%]", "between_rate", "{:.2f}", 100.0),
    ):
        columns = tuple(_pair(count, metric, form, scale) for count in counts)
        tables.append(
            table_of(frame, f"{caption}: on the plan's own grid → in the fine simulation", columns)
        )
    return Document(
        kind="suite-horizon",
        title="Nodes and substeps",
        setting=(
            f"The paper's scenario, planned with N = {', '.join(map(str, counts))} nodes, driven "
            f"on the plan's own grid and with {FINE} Euler–Maruyama steps in all; "
            f"{result.suite.episodes:,} episodes each, seed {result.seed}. Obstacle costs and "
            "collisions at nodes count where controls change, so their number differs with N; "
            "policies were trained at N = 41 and act at every node."
        ),
        tables=tuple(tables),
        notes=notes(result),
        figures=(
            Figure(
                "horizon",
                "Against the number of nodes: mean cost, position error at the goal and "
                "collisions; dashed on the plan's own grid, solid in the fine simulation.",
            ),
        ),
        frames={"table": frame, **frames(result)},
        provenance=result.provenance,
    )


METRICS = ("total", "position_rms", "collision_rate", "between_rate", "effort", "obstacle", "goal")


def grids(result: SuiteResult) -> pd.DataFrame:
    """One line a row; for each metric and N a number on the own grid and one in the fine one."""
    import pandas as pd

    lines = {}
    for row in result.suite.rows:
        line: dict[str, Any] = {}
        for variant in result.suite.variants:
            found = result.results.get((row, variant.label))
            grid = "own" if variant.substeps == 1 else "fine"
            for metric in METRICS:
                value = float("nan") if found is None else float(getattr(found, metric))
                line[f"{metric}_{int(variant.value)}_{grid}"] = value
        lines[row] = line
    return pd.DataFrame.from_dict(lines, orient="index").rename_axis("controller")


def _pair(count: int, metric: str, form: str, scale: float) -> Column:
    own, fine = f"{metric}_{count}_own", f"{metric}_{count}_fine"

    def text(row: Any) -> str:
        return f"{form.format(scale * row[own])} → {form.format(scale * row[fine])}"

    return Column(f"N = {count}", text, value=fine)
