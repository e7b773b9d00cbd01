"""The project as others meet it: what an index shows, what is released, what lies beside what."""

import importlib.util
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def tracked():
    """Files of the repository; the tests may run from a tree without git."""
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.skip("no git here")
    return [name for name in done.stdout.splitlines() if (ROOT / name).is_file()]


def texts():
    """Name -> text of the tracked files that are text."""
    found = {}
    for name in tracked():
        try:
            found[name] = (ROOT / name).read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
    return found


def script(path):
    """A Python file that belongs to no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# --- what an index shows -------------------------------------------------------------------


def test_an_index_can_follow_every_link_of_the_readme():
    setup = script(ROOT / "setup.py")
    text = setup.description((ROOT / "README.md").read_text("utf-8"), PROJECT["urls"]["Repository"])
    links = re.findall(r"\]\(([^)\s]+)", text)
    assert links
    assert [link for link in links if not link.startswith("https://")] == []
    assert re.findall(r"!\[[^]]+\]\((\S+)\)", text) == [
        PROJECT["urls"]["Repository"] + "/raw/main/docs/figure1.png"
    ]


def test_links_that_lead_elsewhere_are_left_alone():
    description = script(ROOT / "setup.py").description
    kept = "[a](https://x.org/b) [c](#d) `e[f](x)`"
    assert description("[a](https://x.org/b) [c](#d)", "https://h") == kept[:28]
    assert description("![p](docs/q.png)", "https://h") == "![p](https://h/raw/main/docs/q.png)"


def test_the_host_is_named_in_one_place():
    host = re.match(r"https://[^/]+", PROJECT["urls"]["Repository"])[0]
    assert [name for name, text in texts().items() if host in text] == ["pyproject.toml"]


def test_the_source_distribution_is_the_repository(tmp_path):
    names = tracked()
    for name in names:
        (tmp_path / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / "source" / name)
    code = f"import setuptools.build_meta as b; b.build_sdist({str(tmp_path)!r})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path / "source", capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (path,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        shipped = {name.partition("/")[2] for name in archive.getnames()}
    assert set(names) - shipped == set()


# --- what is released ----------------------------------------------------------------------


def test_release_notes_are_the_changelogs():
    notes = script(ROOT / ".github" / "release_notes.py").notes
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    text = notes(PROJECT["version"], changelog)
    assert text.startswith("### Added")
    assert "\n## " not in text
    with pytest.raises(ValueError, match=r"no version '9\.9'; it has Unreleased"):
        notes("9.9", changelog)


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"]
    assert "Pavone" in str(citation["references"])
    bibtex = (ROOT / "docs" / "bibliography.md").read_text(encoding="utf-8")
    assert f"version = {{{PROJECT['version']}}}" in bibtex


@pytest.mark.parametrize(
    "path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name
)
def test_workflows_and_templates_are_yaml(path):
    assert yaml.safe_load(path.read_text(encoding="utf-8"))


def test_no_page_of_ours_alone_is_cited():
    word = re.compile(r"\b" + "SP" + "EC" + r"\b")
    assert [name for name, text in texts().items() if word.search(text)] == []


# --- what lies beside weights, and what others start from ----------------------------------


def test_model_cards_are_what_their_command_writes():
    cards = script(ROOT / "benchmarks" / "model_cards.py").cards()
    weights = ROOT / "baselines" / "weights"
    methods = {p.parent / re.sub(r"-\d+$", ".md", p.stem) for p in weights.rglob("*.safetensors")}
    assert set(cards) == methods
    assert {p: p.read_text(encoding="utf-8") for p in cards} == cards


def test_rl_zoo_has_the_configuration_of_ours():
    from slipcar.baselines import PPOConfig

    path = ROOT / "examples" / "tuning" / "rl_zoo.yml"
    zoo, ours = yaml.safe_load(path.read_text(encoding="utf-8"))["SlipCar-v0"], PPOConfig()
    assert zoo["n_timesteps"] == ours.total_steps
    assert zoo["n_envs"] * zoo["n_steps"] == ours.environments * 40
    assert zoo["batch_size"] * ours.minibatches == ours.environments * 40
    assert zoo["learning_rate"] == f"lin_{ours.learning_rate:.0e}".replace("e-0", "e-")
    assert (zoo["n_epochs"], zoo["gamma"]) == (ours.epochs, ours.gamma)
    assert (zoo["gae_lambda"], zoo["clip_range"]) == (ours.gae_lambda, ours.clip_range)


def test_the_template_of_a_submission_drives():
    from slipcar.envs import Scenario
    from slipcar.evaluation import evaluate
    from slipcar.evaluation.own import load_controller

    scenario = Scenario.named("open")
    path = ROOT / "examples" / "submission" / "controller.py"
    name, controller = load_controller(f"mine={path}:controller", scenario)
    assert name == "mine"
    assert evaluate(controller, scenario, episodes=64, seed=0).position_rms < 1.0


def test_the_search_with_optuna_searches():
    pytest.importorskip("optuna")
    pytest.importorskip("stable_baselines3")
    study = script(ROOT / "examples" / "tuning" / "tune_ppo.py").search(trials=2, steps=10_240)
    assert len(study.trials) == 2
    assert np.isfinite(study.best_value)
    assert set(study.best_params) == {"learning_rate", "log_std_init", "gae_lambda"}
