"""`slipcar train`: each method learns into its folder, and options of another are refused."""

import pytest

pytest.importorskip("stable_baselines3")

from slipcar.baselines import load_policy
from slipcar.envs import Family
from slipcar.evaluation.cli import main

PPO = ["--total-steps", "100", "--environments", "4", "--minibatches", "2", "--hidden", "8"]
PATHWISE = ["--pathwise.iterations", "2", "--pathwise.paths", "4", "--pathwise.hidden", "8"]
CLONING = ["--cloning.episodes", "8", "--cloning.epochs", "1", "--cloning.worlds", "1"]
QUICK = {
    "ppo": [*PPO, "--validation-episodes", "4"],
    "pathwise": [*PATHWISE, "--pathwise.validation-episodes", "4"],
    "cloned": [*CLONING, "--cloning.validation-episodes", "4", "--cloning.hidden", "8"],
    "warm-started": [*PPO, *CLONING, "--cloning.validation-episodes", "4"],
}


@pytest.mark.parametrize("method", QUICK)
def test_each_method_leaves_a_policy(method, tmp_path, capsys):
    folder = tmp_path / "run"
    assert main(["train", "--method", method, "--folder", str(folder), *QUICK[method]]) == 0
    policy = load_policy(folder)
    assert policy.sizes == (12, 8, 2)
    assert policy.training["seed"] == 0
    assert "10,000 fresh episodes: cost" in capsys.readouterr().out


def test_several_seeds_have_a_folder_each(tmp_path):
    seeds = ["--seed", "3", "--seeds", "2"]
    assert main(["train", *seeds, "--folder", str(tmp_path), *QUICK["ppo"]]) == 0
    found = [load_policy(tmp_path / f"seed-{seed}").training["seed"] for seed in (3, 4)]
    assert found == [3, 4]


def test_a_family_and_a_policy_to_start_from(tmp_path, capsys):
    first = ["--method", "cloned", *QUICK["cloned"]]
    second = ["--method", "pathwise", *QUICK["pathwise"], "--initial", str(tmp_path / "a")]
    for options, folder in ((first, "a"), (second, "b")):
        world = ["--scenario", "family:easy", "--folder", str(tmp_path / folder)]
        assert main(["train", *world, *options]) == 0
    policy = load_policy(tmp_path / "b")
    assert policy.trained_on == Family.named("easy")
    assert (policy.observation, policy.obstacle_slots) == ("egocentric", 2)
    assert policy.training["initial"] == load_policy(tmp_path / "a").fingerprint()
    assert "in 100 held-out worlds: cost" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--pathwise.paths", "3"], "--pathwise.paths is no option of --method ppo"),
        (["--method", "pathwise", "--total-steps", "3"], "--total-steps is no option"),
        (["--method", "cloned", "--initial", "x"], "no weights at x.safetensors"),
        (["--seeds", "0"], "seeds must be at least 1, not 0"),
        (["--scenario", "family:moon"], "unknown family 'moon'"),
        (["--scenario", "moon"], "unknown scenario 'moon'"),
    ],
)
def test_what_is_refused(options, message, capsys):
    assert main(["train", *options]) == 2
    assert message in capsys.readouterr().err
