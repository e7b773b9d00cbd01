import csv
import errno
import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from slipcar.evaluation.cli import main
from slipcar.evaluation.commands.report import report
from slipcar.evaluation.report import folder as report_folder
from slipcar.evaluation.report.document import Document, Figure
from slipcar.evaluation.report.table import Table


def result(kind, title, **frames):
    index = pd.Index(["a", "b"], name="controller")
    table = pd.DataFrame({"total": [1.5, 0.1 + 0.2], "error": ["", "ValueError: x"]}, index=index)
    return Document(
        kind=kind,
        title=title,
        setting=f"{title} was run.",
        tables=(Table(f"{title}: cost", ("who", "x"), (("a", "1"),), ((None, 1.0),)),),
        notes=(),
        figures=(Figure("shape", "A shape."),),
        frames={"table": table, **frames},
        provenance={"cpu": "Z80", "versions": {"numpy": "2"}},
    )


@pytest.fixture
def results(tmp_path):
    """Folders whose names do not say the order."""
    for folder, kind in (
        ("a/frontier", "frontier"),
        ("z", "compare"),
        ("b", "suite-slip"),
        ("c", "learning"),
        ("0", "something new"),
        (".hidden", "compare"),
    ):
        result(kind, f"The {kind}").save(tmp_path / "results" / folder)
    return tmp_path / "results"


# ------------------------------------------------------------------ what is found


def test_results_are_found_below_and_ordered_by_kind(results):
    found = report_folder.find(results)
    assert [section.name for section in found.sections] == ["z", "c", "b", "a/frontier", "0"]
    assert [section.folder for section in found.sections][3] == results / "a" / "frontier"
    assert found.problems == []


def test_a_folder_of_one_result_is_named_by_its_kind(results):
    (section,) = report_folder.find(results / "z").sections
    assert section.name == "compare"


def test_what_cannot_be_read_is_named_and_the_others_are_shown(results, capsys):
    broken, other = results / "b" / "document.json", results / "c" / "document.json"
    broken.write_bytes(broken.read_bytes()[:50])
    data = json.loads(other.read_text(encoding="utf-8"))
    other.write_text(json.dumps({**data, "format": 7}), encoding="utf-8")
    assert report(results) == 1
    text = capsys.readouterr().out
    page = (results / "report.html").read_text(encoding="utf-8")
    for shown in (text, page):
        assert f"{broken} is damaged" in shown
        assert f"{other} has format 7" in shown
        assert "The frontier" in shown


@pytest.mark.parametrize("make", [None, "empty", "file"])
def test_folders_without_results_are_named(tmp_path, make):
    folder = tmp_path / "nothing"
    if make == "empty":
        folder.mkdir()
    elif make == "file":
        folder.write_text("x", encoding="utf-8")
    message = "no results in" if make == "empty" else "is no folder"
    with pytest.raises(ValueError, match=message) as caught:
        report(folder)
    assert str(folder) in str(caught.value)


def test_only_damaged_results_are_an_error(tmp_path):
    (tmp_path / "document.json").write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / "document.json"))):
        report(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["document.json"]


# ------------------------------------------------------------------ what is written


def test_all_files_are_written_and_named(results, capsys):
    pytest.importorskip("pyarrow")
    assert report(results) == 0
    names = {path.name for path in results.iterdir() if path.is_file()}
    assert names == {"report.html", "report.md", "report.tex"}
    data = {path.name for path in (results / "report-data").iterdir()}
    stems = ("z", "c", "b", "a-frontier", "0")
    assert data == {f"{stem}-table.{suffix}" for stem in stems for suffix in ("csv", "parquet")}
    text = capsys.readouterr().out
    assert all(name in text for name in names | data)


def test_the_same_results_are_the_same_bytes(results, tmp_path):
    report(results, out=tmp_path / "one" / "report.html")
    report(results, out=tmp_path / "two" / "report.html")
    files = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*")]
    assert len(files) > 8
    for path in files:
        assert (tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes()


def test_raw_numbers_are_the_frames(results):
    pytest.importorskip("pyarrow")
    report(results / "z", out=results / "page.html")
    frame = result("compare", "").frames["table"]
    stem = results / "page-data" / "compare-table"
    read = pd.read_csv(f"{stem}.csv", index_col="controller")
    np.testing.assert_array_equal(read["total"], frame["total"])
    back = pd.read_parquet(f"{stem}.parquet").set_index("controller")
    np.testing.assert_array_equal(back["total"], frame["total"])
    assert back["error"].tolist() == frame["error"].tolist()


def test_columns_of_mixed_types_become_text_in_parquet():
    pytest.importorskip("pyarrow")
    import io

    index = pd.Index(["x", "y", "z"])
    frame = pd.DataFrame({"n": [1.0, np.nan, np.inf], "said": ["a", 3, None]}, index=index)
    back = pd.read_parquet(io.BytesIO(report_folder.parquet(frame.rename_axis("who"))))
    assert back["who"].tolist() == ["x", "y", "z"]
    np.testing.assert_array_equal(back["n"], frame["n"])
    assert back["said"].tolist()[:2] == ["a", "3"]


def test_without_pyarrow_the_rest_is_written_and_told(results, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert report(results) == 0
    assert "pip install 'pyarrow>=" in capsys.readouterr().out
    names = {path.suffix for path in (results / "report-data").iterdir()}
    assert names == {".csv"}


def test_markdown_holds_every_table_and_figure(results, tmp_path):
    (results / "b" / "shape.png").write_bytes(b"png")
    report(results, out=tmp_path / "elsewhere" / "r.html")
    text = (tmp_path / "elsewhere" / "r.md").read_text(encoding="utf-8")
    for section in report_folder.find(results).sections:
        assert section.document.markdown().rstrip() in text
    links = re.findall(r"!\[A shape\.\]\(<(.*?)>\)", text)
    assert len(links) == 5
    where = [Path(os.path.normpath(tmp_path / "elsewhere" / link)) for link in links]
    assert results / "b" / "shape.png" in where


def test_latex_is_a_whole_document(results):
    report(results)
    text = (results / "report.tex").read_text(encoding="utf-8")
    assert text.startswith(r"\documentclass")
    assert text.rstrip().endswith(r"\end{document}")
    assert r"\usepackage{booktabs}" in text
    opened = re.findall(r"\\begin\{(\w+)\}", text)
    closed = re.findall(r"\\end\{(\w+)\}", text)
    assert sorted(opened) == sorted(closed)
    assert opened.count("tabular") == 5
    assert r"\section{The suite-slip}" in text


def test_printed_tables_come_as_csv_too(results):
    """The downloads of the page: what is printed, cell by cell."""
    import base64

    report(results / "z")
    page = (results / "z" / "report.html").read_text(encoding="utf-8")
    downloads = dict(re.findall(r'download="(.*?)" href="data:[^,]*;base64,(.*?)"', page))
    assert set(downloads) == {"compare-1.csv", "compare-1.tex", "compare-1.md", "compare-table.csv"}
    text = base64.b64decode(downloads["compare-1.csv"]).decode()
    assert list(csv.reader(text.splitlines())) == [["who", "x"], ["a", "1"]]
    raw = base64.b64decode(downloads["compare-table.csv"]).decode()
    assert raw == (results / "z" / "table.csv").read_text(encoding="utf-8")


# ------------------------------------------------------------------ bad input


def test_a_full_disk_leaves_no_half_file(results, monkeypatch):
    def full(path, content):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left on device: .*report\.html"):
        report(results)
    assert not [path for path in results.iterdir() if path.is_file()]


def test_a_page_that_cannot_be_written_is_named(results, tmp_path):
    (tmp_path / "file").write_text("x", encoding="utf-8")
    with pytest.raises(OSError, match="file"):
        report(results, out=tmp_path / "file" / "report.html")


def test_the_page_is_html(results):
    with pytest.raises(ValueError, match=r"--out is an HTML file.*'page\.md'"):
        report(results, out=Path("page.md"))


def test_the_command_says_what_is_wrong_in_a_line(results, tmp_path, capsys):
    assert main(["report", str(results / "z"), "--out", str(tmp_path / "r.html")]) == 0
    assert str(tmp_path / "r.html") in capsys.readouterr().out
    assert main(["report", str(tmp_path / "absent")]) == 2
    error = capsys.readouterr().err
    assert error == f"slipcar report: error: {tmp_path / 'absent'} is no folder\n"


def test_open_shows_the_page(results, monkeypatch):
    shown = []
    monkeypatch.setattr("webbrowser.open", shown.append)
    report(results, open=True)
    assert shown == [(results / "report.html").resolve().as_uri()]
