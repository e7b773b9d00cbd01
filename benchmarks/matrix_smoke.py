"""Whether an installed slipcar works: import, plan, environments, comparison, files.

    python benchmarks/matrix_smoke.py         # in any environment that has slipcar

Right values are the paper case's. What belongs to an extra is tried where its packages are
installed. The last line names the versions of everything that was used.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import sys
import tempfile
import traceback
from pathlib import Path

import numpy as np


def has(*names: str) -> bool:
    return all(importlib.util.find_spec(name) is not None for name in names)


def plans() -> None:
    from slipcar.envs import Scenario
    from slipcar.planner import Feedback, Plan, RecedingHorizon, plan, plan_batch

    s = Scenario.named("paper")
    p = plan(s)
    assert p.status.ok, p.message
    assert abs(p.cost - 4.402035) < 1e-4, p.cost
    assert p.certificate.violations.largest < 1e-2
    assert abs(plan(s, compiled=False).cost - p.cost) < 1e-6
    for solver in ("structured", *(n for n in ("osqp", "cvxpy") if has(n))):
        other = plan(s, solver=solver, method="convex")
        assert other.status.ok, f"{solver}: {other.message}"
        assert abs(other.cost - p.cost) < 1e-2, (solver, other.cost)
    assert all(q.status.ok for q in plan_batch([Scenario.random(i) for i in range(4)]))
    assert plan(s, feedback=True, risk=0.01).status.ok
    RecedingHorizon(s).predict(np.zeros(6, dtype=np.float32))
    with tempfile.TemporaryDirectory() as folder:
        q = Plan.load(p.save(Path(folder) / "plan.npz"))
    assert Feedback(q).fingerprint() == Feedback(p).fingerprint()


def environments() -> None:
    import gymnasium as gym
    from gymnasium.utils.env_checker import check_env

    name = "slipcar.envs:SlipCar-v0"
    env = gym.make(name, scenario="gap", observation="state")
    check_env(env.unwrapped, skip_render_check=True)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.scenario == env.unwrapped.scenario
    envs = gym.make_vec(name, num_envs=3, max_episode_steps=10)
    envs.reset(seed=0)
    for _ in range(10):
        *_, truncated, _ = envs.step(envs.action_space.sample())
    assert truncated.all()
    if has("pygame"):
        picture = gym.make(name, render_mode="rgb_array")
        picture.reset(seed=0)
        assert picture.render().ndim == 3


def comparisons() -> None:
    from slipcar.baselines import load_policy
    from slipcar.envs import Scenario
    from slipcar.evaluation import compare
    from slipcar.evaluation.cli import COMMANDS, main
    from slipcar.planner import Feedback, OpenLoop, plan

    for command in COMMANDS:
        assert main([command, "--help"]) == 0, command
    s = Scenario.named("paper")
    p = plan(s)
    rows = {"SCP": OpenLoop(p), "feedback": Feedback(p), "PPO": load_policy()}
    found = compare(rows, s, episodes=1024, seed=0, n_jobs=2, progress=False)
    total = found.results["feedback"].total
    assert 4.9 < total < 5.3, total
    with tempfile.TemporaryDirectory() as folder:
        found.save(folder, figures=has("matplotlib"))
        assert json.loads((Path(folder) / "results.json").read_text())["episodes"] == 1024
        assert main(["report", folder]) == 0
        assert main(["plan", "--starts", "2"]) == 0


def data() -> None:
    from slipcar.baselines import load_policy
    from slipcar.evaluation.dataset import write_dataset

    with tempfile.TemporaryDirectory() as folder:
        assert write_dataset(load_policy(), "paper", "a/b-v0", 4, folder=folder).steps == 160


def cluster() -> None:
    from slipcar.baselines import load_policy
    from slipcar.evaluation import compare

    found = compare({"PPO": load_policy()}, "paper", 64, cluster="dask", n_jobs=1, progress=False)
    assert found.results["PPO"].episodes == 64


def video() -> None:
    from slipcar.evaluation.cli import main

    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "drive.mp4"
        assert main(["simulate", "--episodes", "1", "--video", str(film)]) == 0
        assert film.stat().st_size > 10_000


def learning() -> None:
    from slipcar.baselines import PPOConfig, train_ppo
    from slipcar.envs import SlipCarTorchEnv

    config = PPOConfig(
        total_steps=320, environments=8, minibatches=1, epochs=1, validation_episodes=8
    )
    train_ppo("paper", config, progress=False)
    SlipCarTorchEnv(4).reset(seed=0)


#: What is tried, and the packages it needs beside the package's own dependencies.
TRIED = {
    plans: (),
    environments: (),
    comparisons: (),
    data: ("minari", "h5py"),
    cluster: ("distributed",),
    video: ("imageio_ffmpeg", "pygame"),
    learning: ("torch", "stable_baselines3"),
}
PACKAGES = (
    "numpy", "scipy", "llvmlite", "array-api-compat", "gymnasium", "joblib", "threadpoolctl",
    "safetensors", "pandas", "tabulate", "jinja2", "rich", "tyro", "docstring-parser", "torch",
    "stable-baselines3", "tensorboard", "tqdm", "matplotlib", "pillow", "pygame-ce", "osqp",
    "cvxpy", "clarabel", "imageio-ffmpeg", "moviepy", "minari", "distributed", "pyarrow",
)  # fmt: skip


def main() -> None:
    """Try everything; what fails is told, and the exit code is 1."""
    failed = []
    for part, needed in TRIED.items():
        if not has(*needed):
            continue
        print(f"{part.__name__} ...", file=sys.stderr, flush=True)
        try:
            part()
        except Exception as error:  # the others may work
            traceback.print_exc()
            failed.append(f"{part.__name__}: {type(error).__name__}: {error}")
    versions = []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    print(", ".join(versions))
    if failed:
        raise SystemExit("Errors in " + "; ".join(" ".join(line.split()) for line in failed))


if __name__ == "__main__":
    main()
