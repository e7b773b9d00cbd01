import csv
import json
import re

import numpy as np
import pandas as pd
import pytest

from slipcar.evaluation.report.document import Document, Figure, from_json, read_document
from slipcar.evaluation.report.table import Column, Table, table_of


@pytest.fixture
def frame():
    index = pd.Index(["a", "b", "c", "d"], name="controller")
    return pd.DataFrame(
        {
            "cost": [3.0, 1.004, 1.0, np.nan],
            "far": [np.inf, 2.0, -np.inf, np.nan],
            "loop": pd.Series([True, False, True, np.nan], index=index, dtype=object),
            "count": [1, 2, 3, 4],
            "least": [False, False, True, False],
            "error": ["", "", "", "ValueError: x"],
        },
        index=index,
    )


COST = Column("cost [m]", lambda row: f"{row['cost']:.2f}", "cost", "least")
FAR = Column("far", lambda row: f"{row['far']:.1f}", "far")


@pytest.fixture
def document(frame):
    return Document(
        kind="compare",
        title="A title",
        setting="What was run.",
        tables=(table_of(frame, "Costs", (COST, FAR)),),
        notes=("d did not finish: ValueError: x",),
        figures=(Figure("shape", "A shape."),),
        frames={"table": frame, "times": frame[["cost"]]},
        provenance={"cpu": "Z80", "python": "3.11", "versions": {"numpy": "2"}, "commit": "f" * 40},
        scene={"obstacles": np.eye(3), "hits": [None, 3]},
    )


# ------------------------------------------------------------------ tables


def test_cells_values_and_emphasis(frame):
    table = table_of(frame, "Costs", (COST, FAR))
    assert table.headers == ("controller", "cost [m]", "far")
    assert table.cells[0] == ("a", "3.00", "inf")
    assert table.values[0] == (None, 3.0, None)  # infinity is no place to sort by
    assert table.values[1] == (None, 1.004, 2.0)
    assert table.cells[3] == ("d", "–", "–")  # it failed
    assert table.values[3] == (None, None, None)
    assert table.bold == {(2, 1)}  # and not "b", which prints the same
    assert [table.numeric(j) for j in range(3)] == [False, True, True]


def test_marked_cells_are_emphasised(frame):
    column = Column("n", lambda row: str(row["count"]), marked="loop", value="count")
    table = table_of(frame, "", (column,))
    assert table.bold == {(0, 1), (2, 1)}
    assert [row[1] for row in table.values] == [1.0, 2.0, 3.0, None]


def test_what_is_not_there_is_not_emphasised(frame):
    column = Column("cost", COST.text, marked="dear", value="cost")
    table = table_of(frame.assign(dear=[True, False, False, True], error=""), "", (column,))
    assert table.cells[3] == ("d", "–")
    assert table.bold == {(0, 1)}


def test_nan_is_a_number_and_not_a_part_of_a_word(frame):
    word = Column("who", lambda row: "finance" if row.name == "a" else "nan")
    number = Column("x", lambda row: f"{row['cost']:.1f} in Ghanaian", value="cost")
    table = table_of(frame.assign(error=""), "", (word, number))
    assert [row[1] for row in table.cells] == ["finance", "nan", "nan", "nan"]
    assert [row[2] for row in table.cells][2:] == ["1.0 in Ghanaian", "–"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cells": (("a",),)}, "'t': row 0 of cells has 1 columns, not 2"),
        ({"values": ((None, 1.0, 2.0),)}, "'t': row 0 of values has 3 columns, not 2"),
        ({"values": ()}, "'t': 1 rows of cells but 0 of values"),
        ({"bold": frozenset({(0, 2)})}, r"'t': bold \(0, 2\) is outside"),
    ],
)
def test_tables_that_do_not_fit_together_are_refused(change, message):
    whole = {"headers": ("x", "y"), "cells": (("a", "1"),), "values": ((None, 1.0),)}
    with pytest.raises(ValueError, match=message):
        Table(caption="t", **{**whole, **change})


# ------------------------------------------------------------------ on disk


def test_a_document_comes_back_whole(document, frame, tmp_path):
    document.save(tmp_path)
    back = read_document(tmp_path)
    for name in ("kind", "title", "setting", "tables", "notes", "figures"):
        assert getattr(back, name) == getattr(document, name)
    pd.testing.assert_frame_equal(back.frames["table"], frame)
    assert list(back.frames) == ["table", "times"]
    assert back.provenance == document.provenance
    assert back.scene == {"obstacles": np.eye(3).tolist(), "hits": [None, 3]}
    assert back.to_json() == document.to_json()


def test_rows_of_the_same_name_come_back(document, tmp_path):
    import dataclasses

    twice = pd.DataFrame({"x": [1.5, 2.5]}, index=pd.Index(["a", "a"], name="who"))
    dataclasses.replace(document, frames={"table": twice}).save(tmp_path)
    pd.testing.assert_frame_equal(read_document(tmp_path).frames["table"], twice)
    nested = twice.set_index("x", append=True)
    with pytest.raises(ValueError, match=r"one name a row, not .*who.*x"):
        dataclasses.replace(document, frames={"table": nested}).to_json()


def test_save_writes_every_rendering(document, tmp_path):
    written = document.save(tmp_path / "deep")
    names = ["table.md", "table.csv", "times.csv", "table.tex", "document.json"]
    assert [path.name for path in written] == names
    assert sorted(path.name for path in (tmp_path / "deep").iterdir()) == sorted(names)
    assert (tmp_path / "deep/table.md").read_text(encoding="utf-8") == document.markdown()
    assert (tmp_path / "deep/table.tex").read_text(encoding="utf-8") == document.latex()


def test_another_format_is_named(document, tmp_path):
    document.save(tmp_path)
    path = tmp_path / "document.json"
    data = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**data, "format": 99}), encoding="utf-8")
    with pytest.raises(
        ValueError, match=re.escape(f"{path} has format 99, and this slipcar reads 1")
    ):
        read_document(tmp_path)


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[1, 2]",
        lambda text: text.replace('"cells"', '"sells"'),
        lambda text: text.replace('"title"', '"tittle"'),
        lambda text: text.replace('"dtype": "float64"', '"dtype": "float6"'),
        lambda text: text.replace('"stem"', '"root"'),
        lambda text: text.replace('"stem": "shape"', '"stem": "../shape"'),
        lambda text: text.replace('"times": {', '"../times": {'),
        lambda text: text.replace('"times": {', '"/tmp/times": {'),
        lambda text: text.replace('"provenance": {"cpu"', '"provenance": [], "x": {"cpu"'),
        lambda text: text.replace('"versions": {"numpy": "2"}', '"versions": "2"'),
        lambda text: text.replace('"commit": "', '"commit": 1, "x": "'),
        lambda text: text.replace('"notes": ["', '"notes": "d did", "x": ["'),
        lambda text: text.replace('"cells": [["a"', '"cells": [[1'),
        lambda text: text.replace('"values": [[null, 3.0', '"values": [[null, "3"'),
    ],
)
def test_a_damaged_file_is_named(document, tmp_path, damage):
    document.save(tmp_path)
    path = tmp_path / "document.json"
    whole = path.read_text(encoding="utf-8")
    path.write_text(damage(whole), encoding="utf-8")
    assert path.read_text(encoding="utf-8") != whole
    with pytest.raises(ValueError, match=re.escape(str(path))):
        read_document(tmp_path)


def test_bytes_that_are_no_text_are_named(tmp_path):
    (tmp_path / "document.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"document\.json is damaged"):
        read_document(tmp_path)
    with pytest.raises(ValueError, match="is damaged"):
        from_json("{")


# ------------------------------------------------------------------ renderings


def rows_of(markdown):
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_markdown_has_all_of_it(document):
    text = document.markdown()
    rows = rows_of(text)
    assert rows[0] == ["controller", "cost [m]", "far"]
    assert rows[2:] == [
        ["a", "3.00", "inf"],
        ["b", "1.00", "2.0"],
        ["c", "**1.00**", "-inf"],
        ["d", "–", "–"],
    ]
    for part in (document.setting, "**Costs**", *document.notes):
        assert part in text
    assert text.endswith("Computed on Z80, Python 3.11, numpy 2, commit ffffffffffff.\n")


def named(name):
    return Table("100 % of a_b", ("who", "x"), ((name, "1"),), ((None, 1.0),))


@pytest.mark.parametrize(
    "name", ["a|b", "a\nb", "<script>x</script>", "2 * 3 * 4", "back\\slash", "_x_"]
)
def test_names_cannot_break_markdown_tables(document, name):
    import dataclasses

    rows = rows_of(dataclasses.replace(document, tables=(named(name),)).markdown())
    assert [len(row) for row in rows] == [2, 2, 2]
    assert re.sub(r"\\(.)", r"\1", rows[2][0]) == " ".join(name.split())
    assert not re.search(r"(?<!\\)<", rows[2][0])


def test_text_begins_no_tag_in_markdown(document):
    import dataclasses

    evil = "<b>x</b> at 1 < 2"
    changed = dataclasses.replace(document, setting=evil, notes=(evil,))
    assert changed.markdown().count(r"\<b>x\</b> at 1 < 2") == 2


def test_text_is_one_paragraph_in_markdown(document):
    import dataclasses

    evil = "boom\n# A heading\n\n| a | b |\n|---|---|\n| 1 | 2 |"
    text = dataclasses.replace(document, notes=(evil,), setting="# no\n# heading").markdown()
    assert "boom # A heading | a | b |" in text
    assert not any(line.startswith("#") for line in text.splitlines())
    assert len(rows_of(text)) == len(rows_of(document.markdown()))
    listed = dataclasses.replace(document, notes=("1. a", "- b", "2.5 m", "> c")).markdown()
    for told in (r"1\. a", r"\- b", "2.5 m", r"\> c"):
        assert f"\n{told}\n" in listed


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("_x_ Δ_{k+1}", r"\_x_ Δ_{k+1}"),
        ("total_p95 of __init__", r"total_p95 of \_\_init__"),
        ("[a](b) [1.0, 2.0]", r"[a\](b) [1.0, 2.0]"),
        ("~a~ &lt; a & b", r"\~a\~ \&lt; a & b"),
    ],
)
def test_markdown_takes_cells_as_text(name, expected):
    from slipcar.evaluation.report.text import markdown_table

    assert rows_of(markdown_table(named(name)))[2][0] == expected


def tabulars(text):
    return re.findall(r"\\begin\{tabular\}\{([lr]+)\}\n(.*?)\\end\{tabular\}", text, re.DOTALL)


def test_latex_is_a_booktabs_table(document):
    ((layout, body),) = tabulars(document.latex())
    assert layout == "lrr"
    for rule in (r"\toprule", r"\midrule", r"\bottomrule"):
        assert body.count(rule) == 1
    lines = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert len(lines) == 5
    assert all(line.count("&") == 2 for line in lines)
    assert r"\textbf{1.00}" in body
    assert r"\caption{Costs.}" in document.latex()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("100 % SCP_1 & co", r"100 \% SCP\_1 \& co"),
        (r"\input{x} $y$ #1 ~^", r"\textbackslash{}input\{x\} \$y\$ \#1 \textasciitilde{}"),
        ("ν ≤ 10⁴ ± x₂", r"$\nu$ $\leq$ 10$^4$ $\pm$ x$_2$"),
        ("a\n\\end{document}", r"a \textbackslash{}end\{document\}"),
    ],
)
def test_latex_takes_text_as_text(document, name, expected):
    import dataclasses

    text = dataclasses.replace(document, tables=(named(name),), notes=(name,)).latex()
    assert expected in text
    assert r"\caption{100 \% of a\_b.}" in text
    remarks = [line for line in text.splitlines() if line.startswith("%")]
    code = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert len(remarks) == 3  # setting, machine and note: a note stays on its line
    assert r"\end{document}" not in code
    bare = re.sub(r"\\[{}]", "", code)
    assert bare.count("{") == bare.count("}")


def test_every_greek_letter_is_a_command():
    from slipcar.evaluation.report.text import tex

    text = tex("αβγδεζηθικλμνξπρστυφχψωΓΔΘΛΞΠΣΦΨΩ⁰¹²³⁴⁵⁶⁷⁸⁹₀₁₂₃₄₅₆₇₈₉")
    assert text.isascii()
    assert text.startswith(r"$\alpha$$\beta$$\gamma$")
    assert text.count("$") == 2 * 53


def test_a_printed_table_as_csv_reads_back(document):
    from slipcar.evaluation.report.text import csv_table

    table = named('a, "b"\nc')
    assert list(csv.reader(csv_table(table).splitlines(keepends=True))) == [
        list(table.headers),
        list(table.cells[0]),
    ]


def test_the_terminal_shows_every_cell_and_note(document):
    from rich.console import Console

    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(document.terminal())
    text = console.export_text()
    for part in (document.setting, "Costs", "cost [m]", "3.00", "inf", *document.notes):
        assert part in text
