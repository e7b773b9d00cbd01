"""The benchmark's page: what was measured comes out as it went in, and nothing else does."""

import dataclasses
import importlib
import re
import sys
from pathlib import Path

import pytest

pytest.importorskip("rich")

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
HERE = {
    "cpu": "A processor",
    "cpu_count": 2,
    "python": "3.11.7",
    "versions": {"numpy": "2.0.0"},
    "date": "2026-01-02",
    "load": 0.25,
    "command": "python benchmarks/run.py --docs",
}


@pytest.fixture(scope="module")
def bench():
    """Imports a module of benchmarks/, which is a folder of scripts and no package."""
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module
    sys.path.remove(str(FOLDER))


@pytest.fixture
def speed(bench):
    rows = [{"planner": "fast", "ms (median)": 0.25, "N": 41}, {"planner": "slow", "N": 81}]
    return bench("report").Section(
        part="speed",
        title="Speed, N = 41 & more",
        about="What is measured.",
        tables={"Times": rows, "Nothing": []},
        figures=("growth",),
        notes=("skipped third: not installed",),
        raw={"seconds": [0.1, 0.2]},
    )


@pytest.fixture
def folder(bench, speed, tmp_path):
    report = bench("report")
    (tmp_path / "growth.png").write_bytes(b"a picture")
    report.save(tmp_path, speed, HERE)
    cold = dataclasses.replace(speed, part="cold", title="Cold start", figures=())
    report.save(tmp_path, cold, {**HERE, "date": "2026-01-03"})
    return tmp_path


def test_a_section_is_read_as_it_was_written(bench, speed, folder):
    section, told = bench("report").load(folder, "speed")
    assert told == HERE
    # JSON knows no tuples.
    assert tuple(section.figures) == speed.figures
    assert tuple(section.notes) == speed.notes
    assert (section.tables, section.raw) == (speed.tables, speed.raw)


def test_section_shows_tables_notes_load_and_command(bench, speed):
    text = bench("report").markdown(speed, HERE)
    assert "| fast" in text
    assert "| 0.25" in text
    assert "nan" not in text  # the slow one has no time
    assert "### Nothing" not in text
    assert "* skipped third: not installed" in text
    assert "load average 0.2" in text or "load average 0.3" in text
    assert f"`{HERE['command']}`" in text


def test_page_has_all_parts_with_links_that_lead_somewhere(bench, folder, tmp_path):
    page = bench("page")
    written = page.write(folder, ("speed", "cold"), tmp_path / "docs")
    text = written[0].read_text(encoding="utf-8")
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert headings == ["How times are taken", "Speed, N = 41 & more", "Cold start"]
    assert re.findall(r"\]\(#(.*)\)", text) == [page.anchor(heading) for heading in headings]
    assert "2026-01-02" in text
    assert "2026-01-03" in text
    (figure,) = re.findall(r"!\[.*\]\((.*)\)", text)
    assert (tmp_path / "docs" / figure).read_bytes() == b"a picture"
    assert written[1:] == [tmp_path / "docs" / figure]


def test_anchors_are_githubs(bench):
    anchor = bench("page").anchor
    assert anchor("One plan, and a thousand") == "one-plan-and-a-thousand"
    assert anchor("Speed, N = 41 & more") == "speed-n--41--more"


def test_a_missing_part_is_not_passed_over(bench, folder, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"worlds\.json"):
        bench("page").write(folder, ("speed", "worlds"), tmp_path / "docs")
    assert not (tmp_path / "docs").exists()


@pytest.mark.parametrize(
    "other", [{"cpu": "Another"}, {"versions": {"numpy": "2.1.0"}}, {"python": "3.12.1"}]
)
def test_parts_from_different_machines_are_not_mixed(bench, folder, tmp_path, other):
    report = bench("report")
    section, told = report.load(folder, "cold")
    report.save(folder, section, {**told, **other})
    with pytest.raises(ValueError, match="cold was measured on another machine"):
        bench("page").write(folder, ("speed", "cold"), tmp_path / "docs")


def test_provenance_names_the_command_and_the_load(bench, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["benchmarks/run.py", "--folder", "a b"])
    told = bench("report").where()
    assert told["command"] == "python benchmarks/run.py --folder 'a b'"
    assert told["cpu"] in bench("report").machine(told)


def test_cold_start_times_each_case_with_a_warm_cache_or_an_empty_one(bench, monkeypatch):
    cold = bench("cold")
    asked = []

    def process(case, cache):
        full = any(Path(cache).iterdir())
        asked.append((case, cache, full))
        (Path(cache) / "code.o").touch()
        if case == "fatrop":
            raise cold.subprocess.CalledProcessError(1, case, stderr="Trace\nno casadi here\n")
        return {"whole": 2.0, "import": 1.0, "first": 0.5, "second": 0.1}

    monkeypatch.setattr(cold, "_fresh_process", process)
    section = cold.section(rounds=3)
    cases = [case for case, _, _ in asked]
    assert cases.count("plan") == 8  # the first round is not counted
    assert cases.count("fatrop") == 1
    for name, (case, empty) in {**cold.CASES, **cold.KINDS}.items():
        full = [f for asked_case, _, f in asked[2:] if asked_case == case]
        if case != "plan":
            assert set(full) == {not empty}, name
    assert [f for case, _, f in asked if case == "plan"][2:] == [True, False] * 3
    assert not any(Path(cache).exists() for _, cache, _ in asked)
    assert section.notes == ("skipped CasADi + fatrop: no casadi here",)
    runs = {row["fresh process"]: row["runs"] for row in section.tables["Import and first plan"]}
    assert set(runs) == set(cold.CASES) - {"CasADi + fatrop"}
    assert set(runs.values()) == {3}
    (kind, *_) = section.tables["A new kind of problem"]
    assert (kind["kind"], kind["runs"]) == ("2 states", 3)
    assert kind["compiling [s] (median)"] == pytest.approx(0.4)


@pytest.mark.parametrize("case", ["nothing", "plan", "receding", "numpy", "pendulums:1"])
def test_a_fresh_process_tells_its_times(bench, tmp_path, case):
    told = bench("cold")._fresh_process(case, str(tmp_path))
    times = set() if case == "nothing" else {"import", "first", "second"}
    assert set(told) == {"whole"} | times
    assert all(seconds > 0.0 for seconds in told.values())
    # What has planned has compiled, but for that which cannot.
    assert bool(list(tmp_path.glob("*.o"))) is (case not in ("nothing", "numpy"))


def test_every_part_belongs_to_one_page(bench):
    run = bench("run")
    parts = [part for _, _, of_page in run.PAGES for part in of_page]
    assert sorted(parts) == sorted(run.PARTS + run.LONG_PARTS)
