"""`slipcar plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from slipcar.evaluation.commands.checks import FIGURES, check_figures, check_file, check_folder
from slipcar.evaluation.commands.inputs import ScenarioOption, read_scenario
from slipcar.evaluation.commands.output import Output, OutputOption, say

if TYPE_CHECKING:
    from slipcar.planner import Plan

_COMPILED = {"auto": None, "yes": True, "no": False}


def plan(
    *,
    scenario: ScenarioOption = "paper",
    variance_weight: float | None = None,
    starts: int | None = None,
    guess: Path | None = None,
    method: Literal["auto", "newton", "convex"] = "auto",
    compiled: Literal["auto", "yes", "no"] = "auto",
    integrator: Literal["euler", "rk4"] | None = None,
    tolerance: float = 1e-4,
    max_iterations: int = 200,
    shooting: bool = False,
    free_final_time: bool = False,
    time_weight: float = 1.0,
    final_time_bounds: tuple[float, float] | None = None,
    solver: Literal["structured", "osqp", "cvxpy"] = "structured",
    trust_region: Literal["adaptive", "paper", "none"] | None = None,
    linearization: Literal["composite", "literal"] = "composite",
    terminal_tolerance: float = 0.0,
    risk: float | None = None,
    risk_at: Literal["nodes", "path"] = "nodes",
    risk_price: float | None = None,
    risk_episodes: int = 100_000,
    feedback: bool = False,
    expected: bool = False,
    save: Path | None = None,
    figure: Path | None = None,
    figures: Path | None = None,
    compare_methods: Path | None = None,
    worlds: int = 40,
    output: OutputOption = Output(),  # noqa: B008  frozen
) -> int:
    """Plan a scenario by stochastic SCP; print each iteration, the plan and what it proves.

    With --risk, --risk-price, --feedback or --expected the plan minimises an expected cost: it
    prints what is expected, and the risk that was asked for with the proof of it. Otherwise a
    certificate checks the maximum principle of the non-linear problem. Ends with exit
    code 1 if the plan did not converge or the risk cannot be kept.

        slipcar plan
        slipcar plan --tolerance 1e-10 --figures figures
        slipcar plan --scenario random:7 --starts 8 --save plan.npz
        slipcar plan --risk 0.01
        slipcar plan --risk 0.01 --risk-at path
        slipcar plan --feedback --risk 0.001 --figures figures --save plan.npz
        slipcar plan --free-final-time --time-weight 2
        slipcar plan --method convex --shooting --tolerance 1e-12
        slipcar plan --solver cvxpy --linearization literal --trust-region paper
        slipcar plan --compare-methods residuals.png

    Calls slipcar.planner.plan, twice (but with --risk): the second is timed, when machine code is
    in memory. It is kept on disk, too: in ~/.cache/slipcar, or in SLIPCAR_CACHE_DIR.

    Args:
        scenario: which world.
        variance_weight: weight w of the integral of tr Sigma [1/(m2 s)]; 0 is deterministic SCP.
            By default 1, or 0 for an expected cost, which counts the noise already.
        starts: guesses to try, the problem's own and others round the obstacles; the best plan
            counts, a table tells what became of each. By default 1, or 6 for an expected cost.
        guess: start from this plan (.npz), of any time grid; the problem's own guess is tried
            beside it unless this one fits and converges.
        method: newton: one LQ problem per iteration, quadratic at the end; convex: the paper's
            scheme, exact convex sub-problems; auto: newton, and convex where it is asked for
            by another option or newton does not converge.
        compiled: Newton's method as machine code, made from the scenario's functions; auto: where
            that is possible; yes says what is in the way, if anything; no takes the same steps in
            NumPy, a few hundred times slower.
        integrator: of the mean; euler is the paper's, and the default but with --risk-at path.
        tolerance: stop when the square of the maximum principle's relative residual falls to this.
        max_iterations: give up after so many.
        shooting: end the convex method by Newton's method on the maximum principle, to 1e-12.
        free_final_time: choose the horizon too; a table tells which were tried.
        time_weight: cost of a second, when the final time is free.
        final_time_bounds: least and largest final time [s]; by default a tenth and ten times the
            scenario's.
        solver: of the convex sub-problems; osqp and cvxpy need slipcar[qp] and imply convex.
        trust_region: of the convex method, implied; by default adaptive. paper: 100, times 0.99
            at each iteration.
        linearization: of the obstacle cost; literal is as the paper prints it, and implies convex.
        terminal_tolerance: half-width of a box round the terminal condition; > 0 implies convex.
        risk: the probability of any collision must not exceed this, in (0, 1).
        risk_at: where it is promised: at any node of the discretised chain, or on the path, at any
            instant of the stochastic differential equation; then --integrator is rk4.
        risk_price: add this cost per unit of collision probability, without Monte Carlo.
        risk_episodes: fresh paths that verify the risk.
        feedback: plan gains too, for the least expected cost.
        expected: charge the obstacle cost's expectation, in open loop.
        save: write the plan to this .npz file (slipcar.planner.Plan.load reads it).
        figure: write the paper's Figure 1 of this plan, as .png, .pdf or .svg.
        figures: write to this folder, as .png and .pdf: Figure 1, the covariance against sample
            paths and, unless the cost is an expected one, the Hamiltonian along the control with
            the multipliers.
        compare_methods: write residual against iteration and time for the methods, on this
            scenario and faintly on random ones, as .png, .pdf or .svg.
        worlds: how many random ones, for --compare-methods.
        output: what is printed.
    """
    from slipcar.planner import Plan
    from slipcar.planner import plan as make_plan

    world = read_scenario(scenario)
    check_file(save, (".npz",), "a plan")
    check_file(figure, FIGURES, "a figure")
    check_file(compare_methods, FIGURES, "a figure")
    if figures is not None:
        check_folder(figures)
    check_figures(any(path is not None for path in (figure, figures, compare_methods)))
    if worlds < 0:
        raise ValueError(f"worlds must be >= 0, not {worlds}")
    options: dict[str, Any] = {
        "variance_weight": variance_weight,
        "starts": starts,
        "guess": None if guess is None else Plan.load(guess),
        "method": method,
        "compiled": _COMPILED[compiled],
        "integrator": integrator,
        "tolerance": tolerance,
        "max_iterations": max_iterations,
        "shooting": shooting,
        "free_final_time": free_final_time,
        "time_weight": time_weight,
        "final_time_bounds": final_time_bounds,
        "solver": solver,
        "trust_region": trust_region,
        "linearization": linearization,
        "terminal_tolerance": terminal_tolerance,
        "risk": risk,
        "risk_at": risk_at,
        "risk_price": risk_price,
        "risk_episodes": risk_episodes,
        "feedback": feedback,
        "expected": expected,
    }
    first = make_plan(world, **options)
    found = first if risk is not None else make_plan(world, **options)
    written: list[str] = []
    if save is not None:
        save.parent.mkdir(parents=True, exist_ok=True)
        found.save(save)
        written.append(f"plan in {save}")
    try:
        if figure is not None:
            _draw(found, figure)
            written.append(f"figure in {figure}")
        if figures is not None:
            written += [f"figure in {path}" for path in _draw_all(found, figures)]
        if compare_methods is not None:
            _compare_methods(world, worlds, compare_methods)
            written.append(f"figure in {compare_methods}")
    finally:
        _print(output, found, first.solve_time, written)
    return 0 if found.status.ok else 1


def _print(output: Output, found: Plan, first_seconds: float, written: list[str]) -> None:
    from slipcar.evaluation.commands import plan_text as text

    out = output.console()
    if found.alternatives:
        out.print(text.alternatives_table(found), "")
    out.print(text.iterations_table(found), "")
    if found.time_search:
        out.print(text.horizons_table(found), "")
    say(out, text.summary(found, first_seconds))
    if found.expected is None:
        say(out, f"\n{found.certificate}")
    for line in written:
        out.print(line, markup=False, soft_wrap=True)
    if not found.status.ok:
        output.wrong([text.ended(found)])
    output.data(text.as_data(found))


def _draw(found: Any, path: Path) -> None:
    from slipcar.evaluation import sample_paths
    from slipcar.evaluation.figures import saved as plots

    # A free final time makes another scenario: the plan knows which.
    states, _ = sample_paths(plots.played(found), found.problem, plots.SHOWN_PATHS)
    _write(plots.iterations_figure(found.problem, found, states), path)


def _draw_all(found: Any, folder: Path) -> list[Path]:
    from slipcar.evaluation.figures import saved as plots
    from slipcar.evaluation.figures.certificate import plot_hamiltonian

    written = plots.save_plan_figures(found.problem, found, folder)
    if found.expected is not None:
        return written
    return written + plots.save_figure(plot_hamiltonian(found), folder, "hamiltonian")


def _compare_methods(world: Any, worlds: int, path: Path) -> None:
    from slipcar.envs import Scenario
    from slipcar.evaluation.figures.residuals import plot_residuals
    from slipcar.evaluation.residuals import residual_curves

    curves = residual_curves(world, repeats=7, interpreted=True)
    others = [residual_curves(Scenario.random(seed)) for seed in range(worlds)]
    _write(plot_residuals(curves, others), path)


def _write(drawn: Any, path: Path) -> None:
    from slipcar.evaluation.figures import saved as plots

    path.parent.mkdir(parents=True, exist_ok=True)
    with plots.style():
        drawn.savefig(path, dpi=150)
