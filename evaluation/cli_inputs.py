"""What the command line's words mean: scenarios and controllers by name or by file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from slipcar.envs.families import Family
from slipcar.envs.scenario import Scenario

if TYPE_CHECKING:
    from rich.console import Console

    from slipcar.evaluation.controller import Controller

_SCENARIO_HELP = (
    "which world: one of "
    + ", ".join(Scenario.names())
    + "; random:SEED or family:NAME:SEED for a drawn one; or a .json file that "
    "Scenario.to_json wrote"
)
#: A scenario, as an option; and one that may be left to the controller.
ScenarioOption = Annotated[str, tyro.conf.arg(metavar="NAME|FILE", help=_SCENARIO_HELP)]
OwnScenarioOption = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="NAME|FILE",
        help=_SCENARIO_HELP + "; by default the one a stored plan or a policy was made for, "
        "and paper for the others",
    ),
]
PaperScenarioOption = Annotated[
    str | None,
    tyro.conf.arg(metavar="NAME|FILE", help=_SCENARIO_HELP + "; the suite paper's alone (paper)"),
]

#: Words for controllers, and what each is.
CONTROLLERS = {
    "scp": "stochastic SCP, open loop",
    "feedback": "stochastic SCP, tracked by an LQR",
    "planned-feedback": "a plan with the feedback that it was planned with",
    "receding": "receding horizon, replanned at every step",
    "deterministic": "deterministic SCP, open loop",
    "straight": "straight line, ignores obstacles",
    "ppo": "PPO, the shipped policy",
}
CONTROLLER_HELP = (
    f"who drives: {', '.join(CONTROLLERS)}; or a plan's .npz file (with its feedback gains if it "
    "has some), or a policy's .safetensors file or folder"
)


def read_scenario(text: str) -> Scenario:
    """The scenario that a word of the command line means.

    Raises:
        ValueError: for an unknown name, a bad seed or a file that is no scenario.
        OSError: if the file cannot be read.
    """
    if text.endswith(".json"):
        return Scenario.from_json(Path(text).read_text(encoding="utf-8"))
    kind, colon, seed = text.partition(":")
    if kind == "random" and colon:
        if not seed.isdecimal():
            raise ValueError(f"random:SEED needs a whole number >= 0, not {seed!r}")
        return Scenario.random(int(seed))
    if kind == "family" and colon:
        name, _, seed = seed.partition(":")
        family = Family.named(name)
        if not seed.isdecimal():
            raise ValueError(
                f"family:NAME:SEED needs a whole number >= 0 after {name!r}, not {seed!r}: one "
                f"world of a family, such as family:{name}:0"
            )
        return family.sample(int(seed))
    if text not in Scenario.names():
        raise ValueError(
            f"unknown scenario {text!r}: it is one of {Scenario.names()}, random:SEED, "
            "family:NAME:SEED, or a .json file"
        )
    return Scenario.named(text)


def read_controller(text: str, scenario: Scenario | None) -> tuple[Controller, Scenario]:
    """The controller that a word of the command line means, and the scenario it is to drive.

    Args:
        text: one of :data:`CONTROLLERS`, a plan's .npz file, or a policy's .safetensors or
            .json file or folder.
        scenario: where it drives; None is the one a stored plan or a policy was made for, and
            the paper's for the others.

    Raises:
        ValueError: for an unknown word or a bad file.
        OSError: if the file cannot be read.
    """
    from slipcar import baselines
    from slipcar.evaluation.makers import chargeable
    from slipcar.planner import Feedback, OpenLoop, Plan, RecedingHorizon, plan

    path = Path(text)
    # A word is the controller, also where a folder happens to have its name.
    stored_policy = path.suffix in (".safetensors", ".json") or path.is_dir()
    if text == "ppo" or (text not in CONTROLLERS and stored_policy):
        policy = baselines.load_policy(None if text == "ppo" else path)
        return policy, scenario or policy.scenario
    if path.suffix == ".npz":
        stored = Plan.load(path)
        made_for = stored.problem if isinstance(stored.problem, Scenario) else None
        world = scenario or made_for or Scenario.named("paper")
        # A plan plays its own controls; the world it is played in says how actions scale.
        stored = stored.replace(problem=world)
        return (OpenLoop(stored) if stored.gains is None else Feedback(stored)), world
    world = scenario or Scenario.named("paper")
    if text == "scp":
        return OpenLoop(plan(world, variance_weight=chargeable(world))), world
    if text == "feedback":
        return Feedback(plan(world, variance_weight=chargeable(world))), world
    if text == "planned-feedback":
        return Feedback(plan(world, feedback=True)), world
    if text == "receding":
        return RecedingHorizon(world), world
    if text == "deterministic":
        return OpenLoop(baselines.deterministic_scp(world)), world
    if text == "straight":
        return baselines.straight(world), world
    raise ValueError(
        f"unknown controller {text!r}: it is one of {list(CONTROLLERS)}, a plan's .npz file, or a "
        "policy's .safetensors file or folder"
    )


def console(width: int = 120) -> Console:
    """Where tables go: at least `width` columns if the output is a file or a pipe."""
    from rich.console import Console

    out = Console(highlight=False)
    return out if out.is_terminal else Console(highlight=False, width=max(width, out.width))
