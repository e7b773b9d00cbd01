"""`slipcar train`."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import docstring_parser
import tyro

from slipcar.baselines import CloneConfig, PathwiseConfig, Policy, PPOConfig, load_policy
from slipcar.envs.families import Family
from slipcar.envs.sources import Source
from slipcar.evaluation.commands.checks import check_folder
from slipcar.evaluation.commands.inputs import read_scenario
from slipcar.evaluation.commands.output import Output, OutputOption, say

#: Fresh episodes that a policy is judged by when it is done, and their first seed.
_EPISODES, _SEED = 10_000, 0
_SCENARIO_HELP = (
    "which world: a name, random:SEED, family:NAME:SEED or a .json file, as elsewhere; or "
    "family:NAME, another world of that family every episode"
)
SourceOption = Annotated[str, tyro.conf.arg(metavar="NAME|FILE", help=_SCENARIO_HELP)]


def _optional(config: type) -> type:
    """A dataclass like `config` whose fields are None where an option is not given.

    What a configuration holds by default depends on the world, which is not known yet.
    """
    documented = docstring_parser.parse(config.__doc__ or "").params
    help_of = {parameter.arg_name: parameter.description for parameter in documented}
    types = typing.get_type_hints(config)
    fields: list[tuple[str, Any, Any]] = []
    for field in dataclasses.fields(config):
        default = str(field.default).strip("()").replace(",", "")
        kind = types[field.name]
        described = tyro.conf.arg(
            help=" ".join((help_of.get(field.name) or "").split()),
            help_behavior_hint=f"(default: {default})",
            metavar=getattr(kind, "__name__", "int").upper()
            + (" ..." if "tuple" in str(kind) else ""),
        )
        fields.append((field.name, Annotated[kind | None, described], None))
    return dataclasses.make_dataclass(f"{config.__name__}Options", fields, frozen=True)


if TYPE_CHECKING:
    PPOOptions: TypeAlias = PPOConfig
    PathwiseOptions: TypeAlias = PathwiseConfig
    CloneOptions: TypeAlias = CloneConfig
else:
    PPOOptions, PathwiseOptions, CloneOptions = map(
        _optional, (PPOConfig, PathwiseConfig, CloneConfig)
    )


def train(
    *,
    method: Literal["ppo", "pathwise", "cloned", "warm-started"] = "ppo",
    scenario: SourceOption = "paper",
    seed: int = 0,
    seeds: int = 1,
    folder: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None,
    initial: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None,
    resume: bool = True,
    config: Annotated[PPOOptions, tyro.conf.arg(name="")] = PPOOptions(),  # noqa: B008  frozen
    pathwise: PathwiseOptions = PathwiseOptions(),  # noqa: B008
    cloning: CloneOptions = CloneOptions(),  # noqa: B008
    output: OutputOption = Output(),  # noqa: B008
) -> int:
    """Train a policy, by default with PPO, which never sees a plan.

    Three million steps take a minute or two on one core and need torch and
    Stable-Baselines3 (pip install 'slipcar[rl]'). Weights (safetensors), their description
    (JSON), checkpoints and tensorboard events go into the folder; an interrupted run of PPO
    continues from its last checkpoint.

        slipcar train
        slipcar train --seed 3 --folder runs/seed3 --total-steps 1000000
        slipcar train --seeds 5                      five trainings: what the seed makes of it
        slipcar train --method pathwise              through the simulation's derivatives
        slipcar train --method cloned                imitates planned feedback: seconds
        slipcar train --method warm-started          the same, and PPO from there
        slipcar train --scenario family:random       another world every episode
        slipcar compare --policy runs/ppo

    Options that are not given are what was measured to work, for a family other values than
    the defaults shown, which are a scenario's. Calls slipcar.baselines.train_ppo,
    train_pathwise, clone_planner or train_warm_started.

    Args:
        method: how to learn; the options below without a prefix are PPO's.
        scenario: which world, or which family of worlds.
        seed: of weights, noise and exploration, at least 0.
        seeds: how many trainings, with this seed and those that follow.
        folder: where everything goes; runs/METHOD by default. Several trainings have their own in
            it: seed-0, seed-1, ...
        initial: a policy to start from, for ppo and pathwise; its training counts as well.
        resume: continue from a checkpoint in the folder.
        config: how to train with PPO.
        pathwise: how to train by pathwise gradients.
        cloning: how to imitate the planner.
        output: what is printed.
    """
    if seeds < 1:
        raise ValueError(f"seeds must be at least 1, not {seeds}")
    source = _read_source(scenario)
    options = {"": _given(config), "pathwise.": _given(pathwise), "cloning.": _given(cloning)}
    start = None if initial is None else load_policy(initial)
    learn = _learner(method, source, options, start, not output.quiet)
    place = Path("runs") / method if folder is None else folder
    check_folder(place)
    trained = []
    for number in range(seed, seed + seeds):
        here = place if seeds == 1 else place / f"seed-{number}"
        policy = learn(number, here, resume)
        score = _score(policy)
        say(output.console(), f"{_judged(score)}\npolicy in {here}")
        trained.append({"seed": number, "folder": str(here), **score})
    output.data(trained)
    return 0


def _learner(
    method: str,
    source: Source,
    options: dict[str, dict[str, Any]],
    initial: Policy | None,
    progress: bool,
) -> Callable[[int, Path, bool], Policy]:
    """What trains with a seed into a folder, going on there or not.

    Args:
        method: how to learn.
        source: what to learn.
        options: those that were given, by prefix.
        initial: what to start from, or None.
        progress: whether to show a bar.

    Raises:
        ValueError: for a bad option, or one of another method.
    """
    from slipcar import baselines
    from slipcar.baselines.warm_start import finetuning

    prefixes = {
        "ppo": [""], "pathwise": ["pathwise."], "cloned": ["cloning."],
        "warm-started": ["", "cloning."],
    }[method]  # fmt: skip
    for prefix, given in options.items():
        if given and prefix not in prefixes:
            option = f"--{prefix}{next(iter(given)).replace('_', '-')}"
            raise ValueError(f"{option} is no option of --method {method}")
    if initial is not None and method not in ("ppo", "pathwise"):
        raise ValueError(f"--initial is no option of --method {method}")
    ppo, pathwise, cloning = options.values()
    if method == "pathwise":
        steps = dataclasses.replace(PathwiseConfig.suited_to(source), **pathwise)
        return lambda seed, folder, _: baselines.train_pathwise(
            source, steps, seed=seed, folder=folder, initial=initial, progress=progress
        )
    copying = dataclasses.replace(CloneConfig.suited_to(source), **cloning)
    if method == "cloned":
        return lambda seed, folder, _: baselines.clone_planner(
            source, copying, seed=seed, folder=folder
        )
    if method == "warm-started":
        on = dataclasses.replace(finetuning(source), **ppo)
        return lambda seed, folder, resume: baselines.train_warm_started(
            source, on, cloning=copying, seed=seed, folder=folder, resume=resume, progress=progress
        )
    how = dataclasses.replace(PPOConfig.suited_to(source), **ppo)
    return lambda seed, folder, resume: baselines.train_ppo(
        source, how, seed=seed, folder=folder, resume=resume, initial=initial, progress=progress
    )


def _given(options: Any) -> dict[str, Any]:
    """The options that were given."""
    values = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    return {name: value for name, value in values.items() if value is not None}


def _read_source(text: str) -> Source:
    """The scenario or family that a word of the command line means."""
    kind, _, name = text.partition(":")
    if kind == "family" and ":" not in name:
        return Family.named(name)
    return read_scenario(text)


def _score(policy: Policy) -> dict[str, Any]:
    """What it reaches on episodes, and of a family in worlds, that it has not met."""
    if isinstance(policy.trained_on, Family):
        from slipcar.baselines import score

        found = score(policy, policy.trained_on.held_out(), _EPISODES, _SEED)
        names = ("episodes", "total", "collision_rate", "position_rms")
        return {"held_out_worlds": 100, **{name: getattr(found, name) for name in names}}
    from slipcar.evaluation import evaluate

    return evaluate(policy, policy.trained_on, _EPISODES, _SEED).summary()


def _judged(score: dict[str, Any]) -> str:
    """The same as a line."""
    rate, rms = score["collision_rate"], score["position_rms"]
    if "held_out_worlds" in score:
        return (
            f"{score['episodes']:,} episodes in {score['held_out_worlds']} held-out worlds: cost "
            f"{score['total']:.3f}, collisions {rate:.2%}, position RMS {rms:.3f} m"
        )
    return (
        f"{score['episodes']:,} fresh episodes: cost {score['total']:.3f} ± "
        f"{score['total_se']:.3f}, collisions {rate:.2%} [{score['collision_low']:.2%}, "
        f"{score['collision_high']:.2%}], position RMS {rms:.3f} m"
    )
