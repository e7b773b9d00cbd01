"""Small controllers with known behaviour."""

import numpy as np
import pytest

from slipcar.envs import Scenario


class Replay:
    """Plays a table of controls (N−1, 2) in physical units, blind to the state."""

    observation = "state"
    closed_loop = False

    def __init__(self, scenario, controls):
        self.scenario = scenario
        self.actions = np.broadcast_to(controls, (scenario.nodes - 1, 2)) / scenario.action_scale

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        k = np.rint(observation[:, 5] / self.scenario.dt).astype(int)
        return self.actions[k].astype(np.float32), state


@pytest.fixture
def replay():
    return Replay


@pytest.fixture
def layers():
    # Local, so that it is pickled by value: workers cannot import this file.
    class Layers:
        """A random two-layer network on features: its sums round by the shape BLAS is given."""

        def __init__(self, seed=0):
            rng = np.random.default_rng(seed)
            self.W1 = rng.normal(size=(12, 64)).astype(np.float32)
            self.W2 = (0.1 * rng.normal(size=(64, 2))).astype(np.float32)

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.tanh(np.tanh(observation @ self.W1) @ self.W2), state

    return Layers


@pytest.fixture
def paper():
    return Scenario.named("paper")


@pytest.fixture
def turning(paper):
    """Controls that make the car slip: it drives a quarter circle."""
    controls = np.zeros((paper.nodes - 1, 2))
    controls[:8, 0], controls[8:16, 1], controls[16:24, 1] = 1.0, 0.7, -0.7
    return controls
