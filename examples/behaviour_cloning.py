"""Learn from a planner: a network imitates planned feedback, from a Minari dataset.

    python examples/behaviour_cloning.py

Needs Minari and torch: pip install "slipcar[data,rl]". Noise on the teacher's actions shows how it
recovers from small errors, which a clone makes.
"""

from __future__ import annotations

import tempfile

import minari
import numpy as np
import torch

from slipcar.baselines import Policy
from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.evaluation.dataset import write_dataset
from slipcar.planner import Feedback, OpenLoop, plan


def network() -> torch.nn.Sequential:
    """12 features in, 2 actions out, two hidden layers."""
    first, second, last = (torch.nn.Linear(*size) for size in ((12, 64), (64, 64), (64, 2)))
    return torch.nn.Sequential(first, torch.nn.ReLU(), second, torch.nn.ReLU(), last)


def clone(net: torch.nn.Module, dataset: minari.MinariDataset, epochs: int) -> float:
    """Least squares on the dataset's actions; returns the last epoch's mean squared error."""
    episodes = list(dataset.iterate_episodes())
    # The last observation of an episode is that of its end: no action belongs to it.
    seen = torch.from_numpy(np.concatenate([e.observations[:-1] for e in episodes]))
    done = torch.from_numpy(np.concatenate([e.actions for e in episodes]))
    adam = torch.optim.Adam(net.parameters())
    steps = epochs * -(-len(seen) // 256)
    rate = torch.optim.lr_scheduler.OneCycleLR(adam, max_lr=3e-3, total_steps=steps)
    for _ in range(epochs):
        total = 0.0
        for rows in torch.randperm(len(seen)).split(256):
            loss = torch.nn.functional.mse_loss(net(seen[rows]), done[rows])
            adam.zero_grad()
            loss.backward()
            adam.step()
            rate.step()
            total += len(rows) * loss.item()
    return total / len(seen)


def policy(net: torch.nn.Sequential, world: Scenario) -> Policy:
    """The network as a controller, in NumPy; `slipcar.baselines.save_policy` would keep it."""
    numbers = [p.detach().numpy() for p in net.parameters()]  # weights and biases by turns
    return Policy(tuple(numbers[0::2]), tuple(numbers[1::2]), np.zeros(2), world)


def main(episodes: int = 1000, epochs: int = 20) -> None:
    """Record the teacher, imitate it, and drive both along new paths."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # for so small a network, more are slower
    world = Scenario.named("paper")
    steered = plan(world, feedback=True)
    net, teacher = network(), Feedback(steered)
    print(f"the teacher's plan: {steered}")
    rows = {"open loop": OpenLoop(plan(world)), "untrained": policy(net, world), "teacher": teacher}
    with tempfile.TemporaryDirectory() as folder:
        options = {"exploration_noise": 0.1, "folder": folder}
        written = write_dataset(teacher, world, "slipcar/paper/noisy-v0", episodes, **options)
        # In Minari's own folder, minari.load_dataset("slipcar/paper/noisy-v0") would find it.
        error = clone(net, minari.MinariDataset(written.path / "data"), epochs)
    print(f"{episodes} noisy episodes, {epochs} epochs: mean squared error {error:.4f}")
    for name, controller in {**rows, "clone": policy(net, world)}.items():
        r = evaluate(controller, world, seed=1)
        cost = f"{r.total:8.3f} ± {r.total_se:.3f}"
        print(f"{name:9s} cost {cost}, collisions {r.collision_rate:.2%}")


if __name__ == "__main__":
    main()
