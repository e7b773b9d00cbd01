"""The README's Python runs as printed, and its table is what the command prints."""

import re
from pathlib import Path

import pytest

from slipcar.evaluation.cli import main

README = Path(__file__).parent.parent / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def test_readme_has_snippets():
    assert len(BLOCKS) >= 5


@pytest.mark.parametrize("index", range(len(BLOCKS)))
def test_snippet_runs(index, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(BLOCKS[index], f"README.md, snippet {index}", "exec"), {"__name__": "readme"})


@pytest.mark.long
def test_table_is_what_the_command_prints(tmp_path):
    assert main(["compare", "--no-figures", "--folder", str(tmp_path)]) == 0
    printed = (tmp_path / "table.md").read_text(encoding="utf-8").split("**Paired")[0]
    rows = [line for line in printed.splitlines() if line.startswith("| ")]
    assert len(rows) == 6
    text = README.read_text(encoding="utf-8")
    assert [row for row in rows if row not in text] == []
