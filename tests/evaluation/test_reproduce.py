"""`slipcar reproduce`: every claim has a verdict, and a line that gives its number again."""

import dataclasses
import json
import re

import numpy as np
import pytest

from slipcar.evaluation.commands.reproduce import reproduce as command
from slipcar.evaluation.report.document import read_document
from slipcar.evaluation.reproduction.claims import (
    DIFFERS,
    NOT_AS_PRINTED,
    NOT_RUN,
    PREAMBLE,
    REPRODUCED,
    agrees,
    claims,
)
from slipcar.evaluation.reproduction.discrepancies import discrepancies
from slipcar.evaluation.reproduction.reproduce import reproduce
from slipcar.evaluation.reproduction.runs import PLANS, path_moments, reference_file
from slipcar.planner import plan

EPISODES = 4000


@pytest.fixture(scope="module")
def done():
    return reproduce(EPISODES)


@pytest.fixture(scope="module")
def told(done):
    return {claim.name: claim for claim in claims(done)}


@pytest.fixture(scope="module")
def space():
    """What the lines go on from."""
    found = {}
    exec(PREAMBLE, found)
    return found


def test_verdicts(told):
    assert len(told) >= 20
    found = {verdict: set() for verdict in (REPRODUCED, NOT_AS_PRINTED, DIFFERS, NOT_RUN)}
    for name, claim in told.items():
        found[claim.verdict].add(name)
    assert found[NOT_AS_PRINTED] == {"6.3 potential", "6.3 clearance"}
    assert found[DIFFERS] == {"6.4 IPOPT", "6.4 iterations"}
    assert "6.4 collisions" in found[REPRODUCED]
    assert "6.4 p⁰ ≠ 0" in found[REPRODUCED]


def test_a_single_path_shows_nothing_about_how_paths_differ(done):
    moments = path_moments(done.runs["ours"].plan, done.scenario, 1)
    few = dataclasses.replace(done, episodes=1, moments=moments)
    verdicts = {claim.name: claim.verdict for claim in claims(few)}
    for name in ("6.1 certain part", "6.2 moments", "6.3 uncertainty"):
        assert verdicts[name] == NOT_RUN


def test_every_line_gives_its_number_again(done, told, space):
    rows = [*told.values(), *discrepancies(done)]
    assert sum(row.value is not None for row in rows) >= 26
    for row in rows:
        again = eval(row.how, space)
        if row.value is not None:
            assert again == pytest.approx(row.value, rel=1e-9, abs=1e-15), row.name


def test_plans_are_made_as_is_said(done, space):
    for name, text in PLANS.items():
        run = done.runs[name]
        np.testing.assert_array_equal(eval(text, space).controls, run.plan.controls)


def test_the_known_discrepancies_in_numbers(done):
    """docs/reproduction.md, as far as so few paths can tell."""
    rate = {name: run.result.collision_rate for name, run in done.runs.items()}
    assert rate["clearance 0.1, w = 0"] == pytest.approx(0.110, abs=0.015)
    assert rate["w = 0"] == pytest.approx(0.0596, abs=0.012)
    assert rate["literal"] > 0.9
    assert rate["printed potential"] > 0.9
    assert not done.runs["literal"].plan.status.ok
    assert done.runs["literal"].clear < 0.5 * done.runs["literal"].plan.iterations
    assert done.runs["literal, adaptive"].plan.status.ok
    assert done.runs["ours"].plan.variance < 0.99 * done.runs["w = 0"].plan.variance
    box = done.runs["terminal box"].plan
    assert np.abs(box.mean[-1] - done.scenario.goal).max() == pytest.approx(1e-3, rel=1e-6)
    value = {row.name: row.value for row in discrepancies(done)}
    assert value["covariance step"] == pytest.approx(5.0, abs=0.01)
    assert value["start"] == pytest.approx(3.0)
    measured, error = done.moments.variance
    assert abs(measured - done.runs["ours"].plan.variance) < 4.0 * error
    assert abs(measured - 5.0 * done.runs["ours"].plan.variance) > 50.0 * error


def test_plans_agree_with_arrays_computed_elsewhere(done):
    assert set(done.agreement) == {"clearance_0.13", "clearance_0.10", "released_recipe"}
    for part, found in done.agreement.items():
        assert found.controls < (1e-5 if part == "released_recipe" else 1e-8)
        assert abs(found.effort) < 1e-6


def test_a_rate_agrees_or_not(done):
    result = done.runs["ours"].result
    assert agrees(result.collision_rate, 10_000, result)
    assert not agrees(result.collision_rate + 0.03, 10_000, result)
    assert agrees(result.collision_rate + 0.03, 100, result)  # of so few it says little


def test_clearance_buys_safety(done):
    rates = [result.collision_rate for result in done.sweep.values()]
    assert rates == sorted(rates, reverse=True)  # the same paths for all


def test_saved_and_read_back_the_same_numbers_every_time(done, tmp_path):
    for folder in ("one", "two"):
        again = done if folder == "one" else reproduce(EPISODES)
        again.save(tmp_path / folder, figures=False)
    names = sorted(path.name for path in (tmp_path / "one").glob("*.csv"))
    assert {"table.csv", "discrepancies.csv", "runs.csv", "covariance.csv", "times.csv"} < set(
        names
    )
    for name in set(names) - {"times.csv"}:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), (
            name
        )
    document = read_document(tmp_path / "one")
    assert document.kind == "reproduce"
    assert len(document.scene["iterates"]["steps"]) == done.runs["ours"].plan.iterations + 1
    assert not document.figures
    frame = document.frames["table"]
    assert frame.loc["6.4 iterations", "value"] == done.runs["ours"].plan.iterations


def test_the_command_writes_tables_figures_and_the_page(done, tmp_path, capsys):
    page = tmp_path / "docs" / "reproduction.md"
    assert command(episodes=300, folder=tmp_path / "out", docs=page) == 0
    printed = capsys.readouterr().out
    assert "6.4 collisions" in printed
    assert "table.csv" in printed
    document = read_document(tmp_path / "out")
    for figure in document.figures:
        assert (tmp_path / "out" / f"{figure.stem}.png").stat().st_size > 10_000
    text = page.read_text(encoding="utf-8")
    for table in document.tables[:2]:
        for row in table.cells:
            assert row[0] in text
    images = re.findall(r"\]\(([^)]+\.png)\)", text)
    assert len(images) == len(document.figures)
    assert all((page.parent / image).exists() for image in images)
    assert text.count("```python") == 1


def test_what_is_not_there_is_not_run_and_said(monkeypatch):
    monkeypatch.setattr("slipcar.evaluation.reproduction.reproduce.reference_file", lambda: None)

    def bare(problem, solver="structured", **options):
        if solver != "structured":
            raise ImportError(f"{solver} is not installed")
        return plan(problem, **options)

    monkeypatch.setattr("slipcar.evaluation.reproduction.runs.plan", bare)
    found = reproduce(50)
    assert not found.agreement
    verdict = {claim.name: claim.verdict for claim in claims(found)}
    assert verdict["6.4 IPOPT"] == verdict["6.2 convex solvers"] == NOT_RUN
    document = found.document()
    assert "Not run: 6.2 convex solvers, 6.4 IPOPT, 6.4 implementation." in document.notes
    assert "agreement" not in document.frames


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episodes": 0}, "episodes must be at least 1, not 0"),
        ({"seed": -1}, "seed must be at least 0, not -1"),
        ({"n_jobs": 0}, "n_jobs must be at least 1"),
    ],
)
def test_bad_numbers_are_refused_before_anything_runs(options, message):
    with pytest.raises(ValueError, match=message):
        reproduce(**options, progress=lambda *_: pytest.fail("it ran"))


def test_bad_references_are_refused(tmp_path):
    bad = tmp_path / "bad.json"
    for text in ("no json", "{}", json.dumps({"clearance_0.13": 1})):
        bad.write_text(text)
        with pytest.raises(ValueError, match=r"bad.json is no reference of the paper's case"):
            reproduce(10, reference=bad)
    with pytest.raises(FileNotFoundError):
        reproduce(10, reference=tmp_path / "none.json")
    with pytest.raises(ValueError, match=r"must name a .md file"):
        command(episodes=10, folder=tmp_path, docs=tmp_path / "page.txt")
    with pytest.raises(ValueError, match="--docs shows the figures"):
        command(episodes=10, folder=tmp_path, docs=tmp_path / "page.md", figures=False)
    assert reference_file() is not None
