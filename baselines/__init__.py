"""What the planner is compared with: learned policies and simpler drivers.

    policy = load_policy()                     # the shipped one: numpy and safetensors alone
    policies = shipped_runs("pathwise")        # all seeds of a method; shipped_methods() lists them
    policy = train_ppo("paper", seed=0)        # three million steps; needs slipcar[rl]
    policy = train_ppo("family:random")        # another world every episode
    policy = train_pathwise("paper")           # through the simulation's derivatives
    policy = clone_planner("paper")            # imitates planned feedback
    policy = train_warm_started("paper")       # the same, and PPO from there
    controller = straight("paper")             # ignores the obstacles
    plan = deterministic_scp("paper")          # ignores the noise

Importing this package imports neither torch nor Stable-Baselines3.
"""

from slipcar.baselines.cloning_config import CloneConfig
from slipcar.baselines.config import PPOConfig
from slipcar.baselines.deterministic import deterministic_scp
from slipcar.baselines.pathwise import train_pathwise
from slipcar.baselines.pathwise_config import PathwiseConfig
from slipcar.baselines.policy import Policy
from slipcar.baselines.ppo import train_ppo
from slipcar.baselines.progress import Progress
from slipcar.baselines.score import Score, score
from slipcar.baselines.shipped import shipped_methods
from slipcar.baselines.storage import load_policy, save_policy, shipped_runs
from slipcar.baselines.straight import straight
from slipcar.baselines.warm_start import clone_planner, train_warm_started

__all__ = [
    "CloneConfig",
    "PPOConfig",
    "PathwiseConfig",
    "Policy",
    "Progress",
    "Score",
    "clone_planner",
    "deterministic_scp",
    "load_policy",
    "save_policy",
    "score",
    "shipped_methods",
    "shipped_runs",
    "straight",
    "train_pathwise",
    "train_ppo",
    "train_warm_started",
]
