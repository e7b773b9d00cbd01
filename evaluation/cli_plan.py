"""`slipcar plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from slipcar.evaluation.cli_inputs import ScenarioOption, console, read_scenario

if TYPE_CHECKING:
    from rich.table import Table


def plan(
    *,
    scenario: ScenarioOption = "paper",
    variance_weight: float = 1.0,
    solver: Literal["structured", "osqp", "cvxpy"] = "structured",
    tolerance: float = 1e-3,
    max_iterations: int = 100,
    save: Path | None = None,
    figure: Path | None = None,
) -> int:
    """Plan a scenario with stochastic SCP and print how the iteration went.

    Ends with exit code 1 if the plan did not converge.

        slipcar plan
        slipcar plan --variance-weight 0 --tolerance 1e-10
        slipcar plan --scenario random:7 --save plan.npz --figure plan.png

    Calls slipcar.planner.plan.

    Args:
        scenario: which world.
        variance_weight: weight w of the integral of tr Sigma [1/(m2 s)]; 0 is deterministic SCP.
        solver: of the convex sub-problems; osqp and cvxpy need slipcar[qp].
        tolerance: stop when the squared change of the controls over two iterations, integrated
            over time, falls below this.
        max_iterations: give up after so many.
        save: write the plan to this .npz file (slipcar.planner.Plan.load reads it).
        figure: write the paper's Figure 1 of this plan, as .png, .pdf or .svg.
    """
    from slipcar.planner import plan as make_plan

    out = console()
    world = read_scenario(scenario)
    if save is not None and save.suffix != ".npz":
        raise ValueError(f"a plan's name ends in .npz, not {save.name!r}")
    if figure is not None and figure.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"a figure's name ends in .png, .pdf or .svg, not {figure.name!r}")
    found = make_plan(
        world,
        variance_weight=variance_weight,
        solver=solver,
        tolerance=tolerance,
        max_iterations=max_iterations,
    )
    out.print(iterations_table(found))
    out.print(summary(found, variance_weight), markup=False)
    if save is not None:
        save.parent.mkdir(parents=True, exist_ok=True)
        found.save(save)
        out.print(f"plan in {save}", markup=False)
    if figure is not None:
        _draw(world, found, figure)
        out.print(f"figure in {figure}", markup=False)
    return 0 if found.status.ok else 1


def summary(found: Any, variance_weight: float) -> str:
    """What came out, in a few lines."""
    return (
        f"{found.status}: {found.status.value}\n"
        f"{found.iterations} iterations in {1e3 * found.solve_time:.1f} ms; "
        f"effort {found.effort:.6f}, obstacle cost {found.obstacle_cost:.6f}, "
        f"integral of tr Σ {found.variance:.6f} (weight {variance_weight:g})"
    )


def iterations_table(found: Any) -> Table:
    """One line an iteration."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    columns = (
        ("effort", lambda i: f"{i.effort:.6f}"),
        ("obstacle", lambda i: f"{i.penalty:.6f}"),
        ("∫ tr Σ dt", lambda i: f"{i.variance:.6f}" if i.variance == i.variance else "–"),
        ("∫ ‖Δu‖² dt", lambda i: f"{i.step:.2e}"),
        ("trust region", lambda i: f"{i.trust_radius:.2e}"),
        ("virtual control", lambda i: f"{i.virtual_control:.1e}"),
        ("accepted", lambda i: "yes" if i.accepted else "no"),
        ("time [ms]", lambda i: f"{1e3 * i.seconds:.2f}"),
    )
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("iteration", justify="right")
    for header, _ in columns:
        table.add_column(Text(header), justify="right")
    for number, iteration in enumerate(found.history, start=1):
        table.add_row(str(number), *(text(iteration) for _, text in columns))
    return table


def _draw(world: Any, found: Any, path: Path) -> None:
    from slipcar.evaluation import plots, sample_paths
    from slipcar.planner import OpenLoop

    states, _ = sample_paths(OpenLoop(found), world, plots.SHOWN_PATHS)
    drawn = plots.iterations_figure(world, found, states)
    path.parent.mkdir(parents=True, exist_ok=True)
    with plots.style():
        drawn.savefig(path, dpi=150)
