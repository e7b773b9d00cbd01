"""The rows of `slipcar compare`: who is compared with whom."""

from __future__ import annotations

import fnmatch
import functools
from collections.abc import Callable, Sequence

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
    only: Sequence[str] = (),
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
        only: names or patterns of the rows wanted (:func:`chosen`); nothing else is planned.
        substeps: of the simulation. Risks are promised at nodes of the planner's chain; with
            several substeps rows are added that promise them at any instant of the SDE.

    Raises:
        ValueError: for a scenario that cannot be driven or planned, or an unknown row.
    """
    makers, notes = row_makers(
        scenario, variance_weight=variance_weight, policy=policy, substeps=substeps
    )
    names = chosen(list(makers), only)
    return {name: makers[name]() for name in names}, notes


def chosen(names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """The names that some words mean, in their own order: whole names, or patterns with * and ?.

    No words mean all of them. Case does not matter.

    Raises:
        ValueError: for a word that means none, listing the names.
    """

    def means(word: str, name: str) -> bool:
        word, name = word.lower(), name.lower()
        return word == name or fnmatch.fnmatchcase(name, word)

    for word in wanted:
        if not any(means(word, name) for name in names):
            raise ValueError(f"no row is called {word!r}; the rows are {list(names)}")
    return [name for name in names if not wanted or any(means(word, name) for word in wanted)]


def row_makers(
    scenario: Scenario | str,
    *,
    variance_weight: float = 1.0,
    policy: Controller | None = None,
    substeps: int = 1,
) -> tuple[dict[str, Callable[[], Controller | Runs]], list[str]]:
    """What makes each of :func:`default_rows`; making one plans no more than it needs.

    Returns:
        Makers by name, and notes, to which those on plans are added as these are made.
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
    planned = {
        DETERMINISTIC: lambda: baselines.deterministic_scp(scenario),
        STOCHASTIC: lambda: plan(scenario, variance_weight=weight),
        CHANCE: lambda: plan(scenario, risk=OPEN_RISK),
        STEERED: lambda: plan(scenario, feedback=True),
        STEERED_CHANCE: lambda: plan(scenario, feedback=True, risk=FEEDBACK_RISK),
        PATH_CHANCE: lambda: plan(scenario, risk=OPEN_RISK, risk_at="path"),
        STEERED_PATH_CHANCE: lambda: plan(
            scenario, feedback=True, risk=FEEDBACK_RISK, risk_at="path"
        ),
    }

    @functools.cache
    def found(name: str) -> Plan:
        if name in (DETERMINISTIC, STOCHASTIC, STEERED):
            planned[name]()  # so that the times in the table are warm ones
        made = planned[name]()
        notes.extend(plan_notes(name, made))
        if made.risk is not None and made.risk.at == "path" and made.status.ok:
            nodes = made.risk.verified_at_nodes or 0.0
            notes.append(f"{name}: {made.risk}; at nodes of the same paths {nodes:.3%}.")
        return made

    def with_margins() -> Controller:
        risk = found(STEERED_CHANCE).risk
        price = risk.price if risk is not None and risk.reached else MARGIN_PRICE
        return RecedingHorizon(scenario, risk_price=price)

    learners = learned(scenario, policy, notes)
    on_path: dict[str, Callable[[], Controller | Runs]] = {
        PATH_CHANCE: lambda: OpenLoop(found(PATH_CHANCE)),
        STEERED_PATH_CHANCE: lambda: Feedback(found(STEERED_PATH_CHANCE)),
    }
    return {
        STRAIGHT: lambda: baselines.straight(scenario),
        DETERMINISTIC: lambda: OpenLoop(found(DETERMINISTIC)),
        STOCHASTIC: lambda: OpenLoop(found(STOCHASTIC)),
        FEEDBACK: lambda: Feedback(found(STOCHASTIC)),
        **{name: functools.partial(learners.__getitem__, name) for name in learners},
        CHANCE: lambda: OpenLoop(found(CHANCE)),
        STEERED: lambda: Feedback(found(STEERED)),
        STEERED_CHANCE: lambda: Feedback(found(STEERED_CHANCE)),
        RECEDING: lambda: RecedingHorizon(scenario),
        RECEDING_MARGINS: with_margins,
        **(on_path if substeps > 1 else {}),
    }, notes


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
