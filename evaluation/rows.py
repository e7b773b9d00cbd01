"""The rows of `slipcar compare`: who is compared with whom."""

from __future__ import annotations

from slipcar import baselines
from slipcar.envs.scenario import Scenario
from slipcar.evaluation.rollout import Controller
from slipcar.planner import Feedback, OpenLoop, plan

STRAIGHT = "straight (ignores obstacles)"
DETERMINISTIC = "deterministic SCP"
STOCHASTIC = "stochastic SCP"
FEEDBACK = "stochastic SCP + feedback"
PPO = "PPO"
#: Paired differences are taken against the paper's method as it stands: open loop.
REFERENCE = STOCHASTIC


def default_rows(
    scenario: Scenario | str,
    *,
    variance_weight: float = 1.0,
    policy: Controller | None = None,
) -> tuple[dict[str, Controller], list[str]]:
    """Controllers by name, in the order of the table, and what a reader must be told of them.

    A straight-line driver that ignores obstacles, deterministic SCP and stochastic SCP in open
    loop, stochastic SCP with feedback, and PPO. The shipped policy knows one scenario only: on
    another its row is left out, and a note says so.

    Args:
        scenario: a scenario or the name of one.
        variance_weight: of the stochastic plans.
        policy: the PPO row; None takes the shipped one.

    Raises:
        ValueError: for a scenario that cannot be driven or planned.
    """
    scenario = Scenario.of(scenario)
    scenario.action_scale  # noqa: B018  raises now if it is unbounded
    notes = []
    plan(scenario)  # so that the times in the table are warm ones, without first-call costs
    deterministic = baselines.deterministic_scp(scenario)
    stochastic = plan(scenario, variance_weight=variance_weight)
    rows: dict[str, Controller] = {
        STRAIGHT: baselines.straight(scenario),
        DETERMINISTIC: OpenLoop(deterministic),
        STOCHASTIC: OpenLoop(stochastic),
        FEEDBACK: Feedback(stochastic),
    }
    for name, found in ((DETERMINISTIC, deterministic), (STOCHASTIC, stochastic)):
        if not found.status.ok:
            notes.append(f"{name}: the plan is {found.status}, {found.status.value}.")
    known = baselines.load_policy() if policy is None else policy
    made_for = getattr(known, "scenario", scenario)
    if made_for == scenario or policy is not None:
        rows[PPO] = known
    if made_for != scenario and policy is None:
        notes.append(
            f"No {PPO} row: the shipped policy was trained on another scenario. Train one with "
            "`slipcar train --scenario ...` and pass it with --policy."
        )
    elif made_for != scenario:
        notes.append(f"{PPO}: the policy was trained on another scenario.")
    return rows, notes
