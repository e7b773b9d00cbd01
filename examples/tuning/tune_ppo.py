"""Search PPO's learning rate and exploration with Optuna: python examples/tuning/tune_ppo.py.

Needs `pip install optuna` beside slipcar[rl]. A trial is a short training; one that does worse than
half of the others at the same step is stopped. The score is the mean cost of a path, by which
training chooses its policy, too; judge the winner by `slipcar compare`, on other noise.
"""

import argparse

import optuna

from slipcar.baselines import PPOConfig, Progress, score, train_ppo


def objective(trial: optuna.Trial, steps: int) -> float:
    """Cost of a path after a short training, on episodes that it has not seen."""
    config = PPOConfig(
        total_steps=steps,
        learning_rate=trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        log_std_init=trial.suggest_float("log_std_init", -2.0, 0.0),
        gae_lambda=trial.suggest_float("gae_lambda", 0.9, 1.0),
        evaluate_every=5,
        validation_episodes=512,
    )

    def report(progress: Progress) -> None:
        if progress.validation is not None:
            trial.report(progress.validation.total, progress.steps)
            if trial.should_prune():
                raise optuna.TrialPruned

    policy = train_ppo("paper", config, seed=0, progress=False, callback=report)
    return score(policy, "paper", episodes=2048, seed=5_000_000).total


def search(trials: int, steps: int) -> optuna.Study:
    """Run the trials; the same numbers on the same machine, each time."""
    study = optuna.create_study(
        sampler=optuna.samplers.TPESampler(seed=0), pruner=optuna.pruners.MedianPruner()
    )
    study.optimize(lambda trial: objective(trial, steps), n_trials=trials)
    return study


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--steps", type=int, default=400_000, help="of each training")
    asked = parser.parse_args()
    study = search(asked.trials, asked.steps)
    print(f"cost {study.best_value:.3f} with {study.best_params}")
