"""One session of a training run: learn, watch, keep the best, write checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from slipcar.baselines.checkpoint import Checkpoint, start_run, write_checkpoint
from slipcar.baselines.config import PPOConfig
from slipcar.baselines.critic import FITTED_ROLLOUTS, adopt
from slipcar.baselines.learner import (
    Learner,
    actor,
    get_state,
    log_to,
    make_learner,
    set_state,
)
from slipcar.baselines.policy import Policy
from slipcar.baselines.progress import Progress
from slipcar.baselines.score import Score
from slipcar.baselines.session import bar_for, training_session
from slipcar.baselines.storage import policy_from_tensors, policy_tensors, save_policy
from slipcar.baselines.watch import Candidate, Watch
from slipcar.envs.sources import Source, base_of


def train(
    source: Source,
    config: PPOConfig,
    seed: int,
    run: dict[str, Any],
    *,
    initial: Policy | None,
    folder: Path | None,
    checkpoint: Checkpoint | None,
    progress: bool,
    callback: Callable[[Progress], None] | None,
) -> Policy:
    """The work behind :func:`slipcar.baselines.train_ppo`, whose arguments are checked.

    Args:
        source: what is learned: a scenario, or a family of them.
        config: how.
        seed: of the run.
        run: its description, from `describe_run`.
        initial: an actor to start from, or None.
        folder: of the run, or None.
        checkpoint: what to continue from, or None to start.
        progress: whether to show a bar.
        callback: the caller's, or None.
    """
    with training_session():
        session = Session(make_learner(source, config, seed), source, config, folder)
        if initial is not None:
            session.count(initial)
        if checkpoint is not None:
            session.restore(checkpoint)
        elif folder is not None:
            start_run(folder, run)
        if initial is not None and checkpoint is None:
            session.adopt(initial)
        if folder is not None:
            log_to(session.learner, str(folder / "tensorboard"))
        session.learn(progress, callback)
        return session.finish(run)


class Session:
    """The learner, and what is watched and kept beside it.

    Attributes:
        learner: the network and its optimiser.
        watch: scores on the way and the best policy.
    """

    def __init__(
        self, learner: Learner, source: Source, config: PPOConfig, folder: Path | None
    ) -> None:
        self.learner, self.source, self.config, self.folder = learner, source, config, folder
        self.watch = Watch(source, config.validation_episodes)
        steps = base_of(source).nodes - 1
        self._rollout = config.environments * steps
        self._iterations = config.iterations(steps)
        self._checkpointed = 0
        self._before = 0

    def count(self, initial: Policy) -> None:
        """Let the initial actor's training, and what the critic is fitted to, count as steps."""
        self._before = int(initial.training.get("steps", 0)) + FITTED_ROLLOUTS * self._rollout

    def adopt(self, initial: Policy) -> None:
        """Start from this actor, whose training time counts."""
        self.watch.take_up(initial)
        adopt(self.learner, initial)
        self._evaluate()

    def restore(self, checkpoint: Checkpoint) -> None:
        """Stand where an earlier session wrote `checkpoint`."""
        set_state(self.learner, checkpoint.state, checkpoint.iteration)
        self._checkpointed = self.learner.num_timesteps
        best = None
        if checkpoint.best:
            policy = policy_from_tensors(checkpoint.best, self.source, self.learner.layout)
            record = checkpoint.best_record
            best = Candidate(policy, record["steps"], Score(**record["validation"]))
        self.watch.go_on(checkpoint.seconds, checkpoint.cpu_seconds, checkpoint.history, best)

    def learn(self, progress: bool, callback: Callable[[Progress], None] | None) -> None:
        """Iterate until `total_steps` are done.

        Raises:
            KeyboardInterrupt: saying where the last checkpoint is.
        """
        total = self._iterations * self._rollout
        done = self.learner.num_timesteps
        bar = bar_for("PPO", total, progress, done)

        def after_iteration() -> None:
            self._watch()
            found = self.watch.latest.validation if self.watch.latest else None
            if found is not None:
                bar.tell(found)
            bar.update(self._rollout)
            if callback is not None:
                iteration, steps = self.learner.iteration, self.learner.num_timesteps
                callback(Progress(iteration, steps, total, self.watch.seconds, found))

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
        # None where the run was complete before this session.
        latest = self.watch.latest or self.watch.judge(*self._now())
        shared = {
            "algorithm": "PPO (Stable-Baselines3)",
            "config": run["config"],
            "seed": run["seed"],
            "initial": run["initial"],
        }
        policies = self.watch.finish(latest, shared)
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
            watch, best = self.watch, self.watch.best
            write_checkpoint(
                self.folder,
                Checkpoint(
                    iteration=iteration,
                    seconds=watch.seconds,
                    state=get_state(self.learner),
                    best={} if best is None else policy_tensors(best.policy),
                    best_record={} if best is None else best.record(),
                    history=watch.history,
                    cpu_seconds=watch.cpu_seconds,
                ),
            )
            self._checkpointed = self.learner.num_timesteps

    def _now(self) -> tuple[Policy, int]:
        """The policy as it stands, and after how many steps."""
        return actor(self.learner, self.source), self._before + self.learner.num_timesteps

    def _evaluate(self) -> None:
        found = self.watch.look(*self._now()).validation
        for name in ("total", "effort", "obstacle", "goal", "collision_rate", "position_rms"):
            self.learner.logger.record(f"validation/{name}", getattr(found, name))
        self.learner.logger.dump(self.learner.num_timesteps)

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
