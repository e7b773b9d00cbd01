"""The rows of `slipcar compare`: who is compared with whom."""

from __future__ import annotations

from slipcar import baselines
from slipcar.envs.scenario import Scenario
from slipcar.evaluation.controller import Controller
from slipcar.evaluation.learned import learned_rows
from slipcar.evaluation.makers import chargeable
from slipcar.evaluation.runs import Runs
from slipcar.planner import Feedback, OpenLoop, Plan, RecedingHorizon, plan

STRAIGHT = "straight (ignores obstacles)"
DETERMINISTIC = "deterministic SCP"
STOCHASTIC = "stochastic SCP"
FEEDBACK = "stochastic SCP + feedback"
PPO = "PPO"
#: Risks that plans of the table promise: any collision on a path, at most so often.
OPEN_RISK, FEEDBACK_RISK = 0.01, 0.001
CHANCE = f"SCP, risk ≤ {100 * OPEN_RISK:g} %"
STEERED = "planned feedback"
STEERED_CHANCE = f"planned feedback, risk ≤ {100 * FEEDBACK_RISK:g} %"
#: The same at any instant of the SDE, where a finer simulation can tell.
PATH_CHANCE, STEERED_PATH_CHANCE = f"{CHANCE} on the path", f"{STEERED_CHANCE} on the path"
RECEDING = "receding horizon"
RECEDING_MARGINS = "receding horizon with margins"
#: Price of risk where none could be calibrated [cost per unit of probability].
MARGIN_PRICE = 30.0
#: Paired differences are taken against the paper's method as it stands: open loop.
REFERENCE = STOCHASTIC


def default_rows(
    scenario: Scenario | str,
    *,
    variance_weight: float = 1.0,
    policy: Controller | None = None,
    substeps: int = 1,
) -> tuple[dict[str, Controller | Runs], list[str]]:
    """Controllers by name, in the order of the table, and what a reader must be told of them.

    A straight-line driver that ignores obstacles, deterministic SCP and stochastic SCP in open
    loop, stochastic SCP with feedback, PPO and what else was learned; then what goes beyond the
    paper: a chance-constrained plan in open loop, plans whose feedback is planned along, without
    and with a bound on their risk, and receding horizons without and with the price of risk that
    bound led to. The shipped policies know one scenario only: on another their rows are left out,
    and a note says so.

    Args:
        scenario: a scenario or the name of one.
        variance_weight: of stochastic SCP; the rows beyond the paper charge what the noise is
            expected to cost, and need none.
        policy: the only learned row; None takes all that are shipped.
        substeps: of the simulation. Risks are promised at nodes of the planner's chain; with
            several substeps rows are added that promise them at any instant of the SDE.

    Raises:
        ValueError: for a scenario that cannot be driven or planned.
    """
    scenario = Scenario.of(scenario)
    scenario.action_scale  # noqa: B018  raises now if it is unbounded
    notes: list[str] = []
    weight = chargeable(scenario, variance_weight)
    if weight != variance_weight:
        notes.append(
            f"{STOCHASTIC}: variance weight 0, because chance reaches v or ω here, and the paper's "
            "penalty needs them certain."
        )
    # So that the times in the table are warm ones, without first-call costs.
    plan(scenario, variance_weight=weight)
    deterministic = baselines.deterministic_scp(scenario)
    stochastic = plan(scenario, variance_weight=weight)
    rows: dict[str, Controller | Runs] = {
        STRAIGHT: baselines.straight(scenario),
        DETERMINISTIC: OpenLoop(deterministic),
        STOCHASTIC: OpenLoop(stochastic),
        FEEDBACK: Feedback(stochastic),
    }
    for name, found in ((DETERMINISTIC, deterministic), (STOCHASTIC, stochastic)):
        notes += plan_notes(name, found)
    rows |= learned(scenario, policy, notes)
    rows |= _beyond_the_paper(scenario, notes)
    if substeps > 1:
        rows |= _on_the_path(scenario, notes)
    return rows, notes


def learned(
    scenario: Scenario,
    policy: Controller | None,
    notes: list[str],
    methods: tuple[str, ...] | None = None,
) -> dict[str, Controller | Runs]:
    """Rows of learned methods: what is shipped for this scenario, or the policy that is given.

    Args:
        scenario: where they are to drive.
        policy: takes the place of all that is shipped; or None.
        notes: what a reader must be told is added to it.
        methods: which of the shipped ones; None is all.
    """
    if policy is not None:
        if isinstance(policy, baselines.Policy) and not policy.knows(scenario):
            notes.append(f"{PPO}: the policy was trained on another scenario.")
        return {PPO: policy}
    if not baselines.load_policy().knows(scenario):
        notes.append(
            f"No {PPO} row: the shipped policies were trained on another scenario. Train one with "
            "`slipcar train --scenario ...` and pass it with --policy."
        )
        return {}
    return {**learned_rows("paper", methods)}


def plan_notes(name: str, found: Plan) -> list[str]:
    """What a reader must be told of a plan: that it is no answer, if it is none."""
    if found.status.ok:
        return []
    more = f" {found.message}" if found.message else ""
    return [f"{name}: the plan is {found.status}, {found.status.value}.{more}"]


def _beyond_the_paper(scenario: Scenario, notes: list[str]) -> dict[str, Controller]:
    """Rows of chance constraints, planned feedback and receding horizons."""
    plan(scenario, feedback=True)  # warm as well
    chance = plan(scenario, risk=OPEN_RISK)
    steered = plan(scenario, feedback=True)
    steered_chance = plan(scenario, feedback=True, risk=FEEDBACK_RISK)
    for name, found in ((CHANCE, chance), (STEERED, steered), (STEERED_CHANCE, steered_chance)):
        notes += plan_notes(name, found)
    risk = steered_chance.risk
    price = risk.price if risk is not None and risk.reached else MARGIN_PRICE
    return {
        CHANCE: OpenLoop(chance),
        STEERED: Feedback(steered),
        STEERED_CHANCE: Feedback(steered_chance),
        RECEDING: RecedingHorizon(scenario),
        RECEDING_MARGINS: RecedingHorizon(scenario, risk_price=price),
    }


def _on_the_path(scenario: Scenario, notes: list[str]) -> dict[str, Controller]:
    """Rows whose risk is promised at any instant; what was verified of each is noted."""
    chance = plan(scenario, risk=OPEN_RISK, risk_at="path")
    steered = plan(scenario, feedback=True, risk=FEEDBACK_RISK, risk_at="path")
    for name, found in ((PATH_CHANCE, chance), (STEERED_PATH_CHANCE, steered)):
        notes += plan_notes(name, found)
        if found.risk is not None and found.status.ok:
            nodes = found.risk.verified_at_nodes or 0.0
            notes.append(f"{name}: {found.risk}; at nodes of the same paths {nodes:.3%}.")
    return {PATH_CHANCE: OpenLoop(chance), STEERED_PATH_CHANCE: Feedback(steered)}
