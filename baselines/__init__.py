"""What the planner is compared with: a learned policy and simpler drivers.

    policy = load_policy()                     # the shipped one: numpy and safetensors alone
    policy = train_ppo("paper", seed=0)        # three million steps; needs slipcar[rl]
    controller = straight("paper")             # ignores the obstacles
    plan = deterministic_scp("paper")          # ignores the noise

Importing this package imports neither torch nor Stable-Baselines3.
"""

from slipcar.baselines.config import PPOConfig
from slipcar.baselines.deterministic import deterministic_scp
from slipcar.baselines.policy import Policy
from slipcar.baselines.ppo import Progress, train_ppo
from slipcar.baselines.score import Score, score
from slipcar.baselines.storage import load_policy, save_policy
from slipcar.baselines.straight import straight

__all__ = [
    "PPOConfig",
    "Policy",
    "Progress",
    "Score",
    "deterministic_scp",
    "load_policy",
    "save_policy",
    "score",
    "straight",
    "train_ppo",
]
