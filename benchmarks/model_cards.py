"""Write a model card beside each shipped policy: python benchmarks/model_cards.py.

One card a method and world, for all its seeds: baselines/weights/WORLD/METHOD.md. Its numbers are
read from the records beside the weights.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slipcar.baselines import shipped_methods, shipped_runs

WEIGHTS = Path(__file__).resolve().parents[1] / "baselines" / "weights"
WORLDS = {
    "paper": """the paper's scenario, `Scenario.named("paper")`: one world, 5 s, and four obstacles
  that the policy is not shown""",
    "random": """the family `random`: one to eight obstacles, another world every episode, the
  nearest of them in the observation""",
}
WHAT = {
    "ppo": """Proximal policy optimisation (Schulman et al. 2017). It learns from costs alone and
  knows nothing of the equations.""",
    "pathwise": """Descent on the expected cost through the derivatives of the simulation; it knows
  the equations.""",
    "cloned": """Least squares on the actions of the planner's feedback, `plan(..., feedback=True)`;
  it knows the equations by its teacher.""",
}
LIMITS = {
    "paper": """It is for this world and these bounds of the controls. Elsewhere it drives to where
  the goal was, without a warning. It does not see obstacles.""",
    "random": """It hardly avoids obstacles: see the collisions below. A plan for the world at hand
  costs less and hits less ([why](../../../docs/learning.md)). It shows eight obstacles at most.""",
}


def card(world: str, method: str) -> str:
    """Markdown of one card."""
    runs = shipped_runs(method, world)
    first = runs[0].training
    sizes = " → ".join(str(size) for size in runs[0].sizes)
    rows = "\n".join(_row(seed, run.training) for seed, run in zip(_seeds(runs), runs, strict=True))
    versions = "; ".join(dict.fromkeys(_versions(run.training) for run in runs))
    load = (
        f'shipped_runs("{method}")' if world == "paper" else f'shipped_runs("{method}", "{world}")'
    )
    return f"""# Model card: {method}, {world}

Written by `python benchmarks/model_cards.py`; do not edit.

* **What it is**: {WHAT[method]}
* **Trained on**: {WORLDS[world]}.
* **Network**: {sizes}, ReLU; observation `{runs[0].observation}`, actions in [−1, 1] scaled by the
  scenario's bounds. The mean of the policy, without exploration.
* **Load**: `slipcar.baselines.{load}`; NumPy and safetensors are all that it takes, and no
  code runs.
* **Meant for**: a row of a comparison, and a start for training. Not for a vehicle.
* **Where it ends**: {LIMITS[world]}
* **Licence**: MIT, as the package.

## Tests

{first["test"]["episodes"]:,} fresh episodes each (evaluation seed {first["test"]["seed"]}); cost
of a path with its standard error.

| seed | cost | collisions | effort | obstacle | goal | training [s] | environment steps |
|---|---|---|---|---|---|---|---|
{rows}

## Trained by

`{first["command"]}`, and the other seeds likewise; {versions}.
"""


def _versions(training: dict[str, Any]) -> str:
    return ", ".join(f"{name} {version}" for name, version in training["versions"].items())


def _seeds(runs: Any) -> list[int]:
    return [int(run.training["seed"]) for run in runs]


def _row(seed: int, training: dict[str, Any]) -> str:
    test = training["test"]
    return (
        f"| {seed} | {test['total']:.3f} ± {test['total_se']:.3f} | {test['collision_rate']:.2%} "
        f"| {test['effort']:.3f} | {test['obstacle']:.3f} | {test['goal']:.3f} "
        f"| {training['seconds']:.0f} | {training['steps']:,} |"
    )


def cards() -> dict[Path, str]:
    """All cards by the file that they belong in."""
    return {
        WEIGHTS / world / f"{method}.md": card(world, method)
        for world in WORLDS
        for method in shipped_methods(world)
    }


if __name__ == "__main__":
    for path, text in cards().items():
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(WEIGHTS.parents[1]))
