"""Learning curves: when is a plan's cost reached, by whom, and how it is told."""

import dataclasses

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import compare, learning
from slipcar.evaluation.rows import FEEDBACK, STOCHASTIC
from slipcar.evaluation.runs import Runs
from slipcar.planner import Feedback, OpenLoop, plan


class Learned:
    """Stands still; remembers a made-up training."""

    def __init__(self, seed, costs):
        self.training = {
            "seed": seed,
            "history": [
                {"steps": 1000 * (i + 1), "seconds": 2.0 * (i + 1), "total": c, "collision_rate": 0}
                for i, c in enumerate(costs)
            ],
        }

    def fingerprint(self):
        return f"seed {self.training['seed']}"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2)), state


@pytest.fixture(scope="module")
def compared():
    p = plan(Scenario.named("paper"))
    runs = Runs.of(
        [Learned(0, (9.0, 6.0, 6.5)), Learned(1, (6.5, 5.5, 4.0)), Learned(2, (9, 9, 9))]
    )
    rows = {STOCHASTIC: OpenLoop(p), FEEDBACK: Feedback(p), "learned": runs}
    return compare(rows, "paper", 2000, progress=False)


def test_a_cost_is_reached_at_the_first_validation_that_is_no_higher(compared):
    curves = learning.curves(compared.controllers)["learned"]
    assert [curve.label for curve in curves] == ["seed 0", "seed 1", "seed 2"]
    assert curves[0].reached(6.9) == (2000.0, 4.0)
    assert curves[1].reached(6.5) == (1000.0, 2.0)
    assert curves[2].reached(6.9) == (np.inf, np.inf)


def test_medians_are_over_the_trainings_that_got_there(compared):
    frame = learning.frame(compared)
    # Open loop costs some 6.9, tracked 5.05.
    line = frame.loc[f"learned → {STOCHASTIC}"]
    assert (line["reached"], line["runs"]) == (2, 3)
    assert (line["steps_median"], line["steps_least"], line["steps_most"]) == (1500, 1000, 2000)
    line = frame.loc[f"learned → {FEEDBACK}"]
    assert (line["reached"], line["seconds_median"]) == (1, 6.0)


def test_it_is_in_the_document_and_the_figure(compared, tmp_path):
    table = learning.table(compared)
    assert table is not None
    assert table.cells[0][3] == "2 of 3"
    written = {path.name for path in compared.save(tmp_path)}
    assert {"learning.csv", "learning.png", "trainings.csv"} <= written
    assert "planning_time" not in (tmp_path / "learning.csv").read_text()


def test_without_trainings_there_is_nothing_to_tell(compared):
    rows = {name: c for name, c in compared.controllers.items() if name != "learned"}
    alone = dataclasses.replace(compared, controllers=rows)
    assert learning.table(alone) is None
