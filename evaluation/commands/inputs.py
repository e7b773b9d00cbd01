"""What the command line's words mean: scenarios and controllers by name or by file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from slipcar.envs.families import Family
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import read_text
from slipcar.evaluation.makers import Maker

if TYPE_CHECKING:
    from slipcar.baselines import Policy
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
MAKERS = {
    "scp": Maker.of("stochastic"),
    "feedback": Maker.of("feedback"),
    "planned-feedback": Maker.of("planned-feedback"),
    "receding": Maker.of("receding"),
    "deterministic": Maker.of("deterministic"),
    "straight": Maker.of("straight"),
    "ppo": Maker.of("ppo"),
}
CONTROLLER_HELP = (
    f"who drives: {', '.join(CONTROLLERS)}; a plan's .npz file (with its feedback gains if it has "
    "some), a policy's .safetensors file or folder; or your own: module:object, file.py:object, a "
    "Stable-Baselines3 model.zip (with --trust), or the name of an installed one"
)


def read_scenario(text: str) -> Scenario:
    """The scenario that a word of the command line means.

    Raises:
        ValueError: for an unknown name, a bad seed or a file that is no scenario.
        OSError: if the file cannot be read.
    """
    if text.endswith(".json"):
        try:
            return Scenario.from_json(read_text(text))
        except ValueError as error:
            raise ValueError(f"{text}: {error}" if text not in str(error) else error) from error
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


def read_controller(
    text: str, scenario: Scenario | None, trust: bool = False
) -> tuple[Controller, Scenario]:
    """The controller that a word of the command line means, and the scenario it is to drive.

    Args:
        text: one of :data:`CONTROLLERS`, a plan's .npz file, a policy's .safetensors or .json file
            or folder, or one's own (:mod:`slipcar.evaluation.own.load`).
        scenario: where it drives; None is the one a stored plan or a policy was made for, and
            the paper's for the others.
        trust: whether a Stable-Baselines3 model may be loaded, which runs what code is in it.

    Raises:
        ValueError: for an unknown word or a bad file.
        OSError: if the file cannot be read.
    """
    from slipcar import baselines
    from slipcar.evaluation.own.load import load_controller
    from slipcar.planner import Feedback, OpenLoop, Plan

    if text == "ppo":
        policy = baselines.load_policy()
        return policy, scenario or _trained_on(policy)
    if text in MAKERS:
        world = scenario or Scenario.named("paper")
        return MAKERS[text](world), world
    path = Path(text)
    if path.suffix == ".npz":
        stored = Plan.load(path)
        made_for = stored.problem if isinstance(stored.problem, Scenario) else None
        world = scenario or made_for or Scenario.named("paper")
        # A plan plays its own controls; the world it is played in says how actions scale.
        stored = stored.replace(problem=world)
        return (OpenLoop(stored) if stored.gains is None else Feedback(stored)), world
    if path.suffix in (".safetensors", ".json") or (path.is_dir() and ":" not in text):
        policy = baselines.load_policy(path)
        return policy, scenario or _trained_on(policy)
    world = scenario or Scenario.named("paper")
    with _words_are_known():
        return load_controller(text, world, trust=trust)[1], world


def _trained_on(policy: Policy) -> Scenario:
    """The scenario of a policy; of one that knows a family, the first world of that."""
    known = policy.trained_on
    return known.sample(0) if isinstance(known, Family) else known


def read_maker(text: str, trust: bool = False) -> tuple[str, Callable[[Scenario], Controller]]:
    """Name of a row, and what makes its controller for any scenario: `--controller` of a table.

    Raises:
        ValueError: if there is no such word, module, object or file.
        OSError: if a file cannot be read.
    """
    from slipcar.evaluation.own.load import load_maker, split_name

    name, word = split_name(text)
    if word in MAKERS:
        return name or word, MAKERS[word]
    with _words_are_known():
        return load_maker(text, trust=trust)


@contextlib.contextmanager
def _words_are_known() -> Iterator[None]:
    """An unknown controller is told which words there are, beside all the other forms."""
    try:
        yield
    except ValueError as error:
        head, colon, rest = str(error).partition(": it is ")
        if not (head.startswith("unknown controller") and colon):
            raise
        raise ValueError(f"{head}: it is one of {list(CONTROLLERS)}, {rest}") from None
