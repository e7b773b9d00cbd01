"""One session of a training run: learn, watch, keep the best, write checkpoints."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from slipcar.baselines.checkpoint import Checkpoint, start_run, versions, write_checkpoint
from slipcar.baselines.config import PPOConfig
from slipcar.baselines.learner import (
    Learner,
    actor,
    get_state,
    log_to,
    make_learner,
    set_state,
    single_thread,
)
from slipcar.baselines.policy import Policy
from slipcar.baselines.ppo import Progress
from slipcar.baselines.score import Score, score
from slipcar.baselines.storage import policy_from_tensors, policy_tensors, save_policy
from slipcar.envs import Scenario

#: First seed of the validation episodes, the same in every run.
VALIDATION_SEED = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A policy met on the way.

    Attributes:
        policy: its actor.
        steps: environment steps after which it stood.
        validation: its score on the validation episodes.
    """

    policy: Policy
    steps: int
    validation: Score


def train(
    scenario: Scenario,
    config: PPOConfig,
    seed: int,
    run: dict[str, Any],
    *,
    folder: Path | None,
    checkpoint: Checkpoint | None,
    progress: bool,
    callback: Callable[[Progress], None] | None,
) -> Policy:
    """The work behind :func:`slipcar.baselines.train_ppo`, whose arguments are checked.

    Args:
        scenario: what is learned.
        config: how.
        seed: of the run.
        run: its description, from `describe_run`.
        folder: of the run, or None.
        checkpoint: what to continue from, or None to start.
        progress: whether to show a bar.
        callback: the caller's, or None.
    """
    with single_thread():
        session = Session(make_learner(scenario, config, seed), scenario, config, folder)
        if checkpoint is not None:
            session.restore(checkpoint)
        elif folder is not None:
            start_run(folder, run)
        if folder is not None:
            log_to(session.learner, str(folder / "tensorboard"))
        session.learn(progress, callback)
        return session.finish(run)


class Session:
    """The learner, and what is watched and kept beside it.

    Attributes:
        learner: the network and its optimiser.
        best: the candidate with the lowest validation cost so far.
        latest: the last one evaluated in this session.
    """

    def __init__(
        self, learner: Learner, scenario: Scenario, config: PPOConfig, folder: Path | None
    ) -> None:
        self.learner, self.scenario, self.config, self.folder = learner, scenario, config, folder
        self.best: Candidate | None = None
        self.latest: Candidate | None = None
        self._rollout = config.environments * (scenario.nodes - 1)
        self._iterations = config.iterations(scenario.nodes - 1)
        self._began = time.perf_counter()
        self._checkpointed = 0

    @property
    def seconds(self) -> float:
        """Training time so far, all sessions together."""
        return time.perf_counter() - self._began

    def restore(self, checkpoint: Checkpoint) -> None:
        """Stand where an earlier session wrote `checkpoint`."""
        set_state(self.learner, checkpoint.state, checkpoint.iteration)
        self._began -= checkpoint.seconds
        self._checkpointed = self.learner.num_timesteps
        if checkpoint.best:
            policy = policy_from_tensors(checkpoint.best, self.scenario)
            record = checkpoint.best_record
            self.best = Candidate(policy, record["steps"], Score(**record["validation"]))

    def learn(self, progress: bool, callback: Callable[[Progress], None] | None) -> None:
        """Iterate until `total_steps` are done.

        Raises:
            KeyboardInterrupt: saying where the last checkpoint is.
        """
        total = self._iterations * self._rollout
        done = self.learner.num_timesteps
        bar = tqdm(
            total=total, initial=done, unit=" steps", unit_scale=True, desc="PPO",
            # A log file keeps every line that a terminal overwrites.
            mininterval=0.5 if sys.stderr.isatty() else 15.0,
            disable=not progress,
        )  # fmt: skip

        def after_iteration() -> None:
            self._watch()
            found = self.latest.validation if self.latest else None
            if found is not None:
                collisions = f"{100.0 * found.collision_rate:.1f} %"
                bar.set_postfix_str(
                    f"cost {found.total:.3f}, collisions {collisions}", refresh=False
                )
            bar.update(self._rollout)
            if callback is not None:
                iteration, steps = self.learner.iteration, self.learner.num_timesteps
                callback(Progress(iteration, steps, total, self.seconds, found))

        self.learner.after_iteration = after_iteration
        try:
            if done < total:
                self.learner.learn(total - done, reset_num_timesteps=False)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(self._farewell(total)) from None
        finally:
            bar.close()

    def finish(self, run: dict[str, Any]) -> Policy:
        """The best policy with its record; it and the last one are saved in the folder."""
        if self.latest is None:  # the run was complete before this session
            self._evaluate()
        assert self.latest is not None
        assert self.best is not None
        shared = {
            "algorithm": "PPO (Stable-Baselines3)",
            "config": run["config"],
            "seed": run["seed"],
            "seconds": round(self.seconds, 1),
            "versions": versions(),
        }
        policies = {}
        for selected, candidate in (("last", self.latest), ("best", self.best)):
            own = {"selected": selected, **_record(candidate), "validation_seed": VALIDATION_SEED}
            policies[selected] = dataclasses.replace(candidate.policy, training={**shared, **own})
        if self.folder is not None:
            save_policy(policies["last"], self.folder / "last")
            save_policy(policies["best"], self.folder / "policy")
        return policies["best"]

    def _watch(self) -> None:
        iteration = self.learner.iteration
        last = iteration == self._iterations
        if last or iteration % self.config.evaluate_every == 0:
            self._evaluate()
        if self.folder is not None and (last or iteration % self.config.checkpoint_every == 0):
            best = self.best
            write_checkpoint(
                self.folder,
                Checkpoint(
                    iteration=iteration,
                    seconds=self.seconds,
                    state=get_state(self.learner),
                    best={} if best is None else policy_tensors(best.policy),
                    best_record={} if best is None else _record(best),
                ),
            )
            self._checkpointed = self.learner.num_timesteps

    def _evaluate(self) -> None:
        policy = actor(self.learner, self.scenario)
        found = score(policy, self.scenario, self.config.validation_episodes, VALIDATION_SEED)
        for name in ("total", "effort", "obstacle", "goal", "collision_rate", "position_rms"):
            self.learner.logger.record(f"validation/{name}", getattr(found, name))
        self.learner.logger.dump(self.learner.num_timesteps)
        self.latest = Candidate(policy, self.learner.num_timesteps, found)
        if self.best is None or found.total < self.best.validation.total:
            self.best = self.latest

    def _farewell(self, total: int) -> str:
        where = f"training stopped after {self.learner.num_timesteps} of {total} steps; "
        if self.folder is None:
            return where + "nothing was kept, because no folder was given"
        if not self._checkpointed:
            return where + f"there is no checkpoint in {self.folder} yet"
        return where + (
            f"the checkpoint in {self.folder} stands at {self._checkpointed}: "
            "the same call continues from there"
        )


def _record(candidate: Candidate) -> dict[str, Any]:
    return {"steps": candidate.steps, "validation": dataclasses.asdict(candidate.validation)}
