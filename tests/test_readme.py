"""The Python of README and docs runs as printed; the README's table is what its command prints.

Notebooks are executed by `make docs`, and there alone.
"""

import re
from pathlib import Path

import pytest

from slipcar.evaluation.cli import main

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = [README, *sorted(DOCS.rglob("*.md")), *sorted((DOCS / "notebooks").glob("*.ipynb"))]
#: A line that shows a file of the repository.
SHOWN = re.compile(r'^--8<-- "([^":]+)"$', re.MULTILINE)


def blocks(page):
    """Python of a page, with the files that it shows."""
    found = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    return [SHOWN.sub(lambda shown: (ROOT / shown[1]).read_text("utf-8"), b) for b in found]


#: Those of the README stand each for itself; those of a page under docs/ go on from one another.
SCRIPTS = [pytest.param(block, id=f"README-{i}") for i, block in enumerate(blocks(README))]
SCRIPTS += [
    pytest.param("\n".join(blocks(page)), id=page.stem) for page in PAGES[1:] if blocks(page)
]


def test_pages_have_snippets():
    assert len(blocks(README)) == 3
    assert len(blocks(ROOT / "docs" / "planner.md")) >= 5


@pytest.mark.parametrize("code", SCRIPTS)
def test_snippets_run(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "snippets", "exec"), {"__name__": "snippets"})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    here = [link for link in links if "://" not in link]
    assert [link for link in here if not (page.parent / link).exists()] == []


@pytest.mark.long
def test_table_is_what_the_command_prints(tmp_path):
    assert main(["compare", "--no-figures", "--folder", str(tmp_path)]) == 0
    printed = (tmp_path / "table.md").read_text(encoding="utf-8")
    first = printed[printed.index("| controller") :].split("\n\n")[0]
    rows = [line for line in first.splitlines() if line.startswith("| ")]
    assert len(rows) == 13  # a heading and twelve controllers
    text = README.read_text(encoding="utf-8")
    assert [row for row in rows if row not in text] == []
