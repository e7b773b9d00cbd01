"""The slipping car and its world: physics, costs, scenarios and Gymnasium environments.

    gym.make("slipcar.envs:SlipCar-v0", scenario="paper", observation="features")
    gym.make_vec("slipcar.envs:SlipCar-v0", num_envs=1024, scenario="family:random",
                 observation="egocentric", vectorization_mode="vector_entry_point")

The module prefix in the id makes it work everywhere, in spawned workers too.
"""

import gymnasium as gym

from slipcar.envs.families import HELD_OUT_SEEDS, Family
from slipcar.envs.overlay import Overlay
from slipcar.envs.scenario import Scenario
from slipcar.envs.slip_car import SlipCarEnv
from slipcar.envs.torch_paths import path_costs
from slipcar.envs.torch_vector import SlipCarTorchEnv
from slipcar.envs.transition import Transition, control_from_action, transition
from slipcar.envs.vector import SlipCarVectorEnv
from slipcar.envs.wrappers import SparseSuccess, VectorSparseSuccess

__all__ = [
    "HELD_OUT_SEEDS",
    "Family",
    "Overlay",
    "Scenario",
    "SlipCarEnv",
    "SlipCarTorchEnv",
    "SlipCarVectorEnv",
    "SparseSuccess",
    "Transition",
    "VectorSparseSuccess",
    "control_from_action",
    "path_costs",
    "transition",
]

# Re-imports (spawned workers, reloads) would otherwise warn about overriding.
if "SlipCar-v0" not in gym.registry:
    gym.register(
        id="SlipCar-v0",
        entry_point="slipcar.envs.slip_car:SlipCarEnv",
        vector_entry_point="slipcar.envs.vector:SlipCarVectorEnv",
    )
