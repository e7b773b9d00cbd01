"""The site: every public name has a docstring and a place in the reference, every page a place.

`make docs` builds it strictly and executes the notebooks; what can be told without that is here.
"""

import ast
import importlib
import inspect
import json
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PACKAGES = ("planner", "envs", "baselines", "evaluation")
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
ENTRY = re.compile(r"^::: (slipcar[\w.]+)\.(\w+)$", re.MULTILINE)


def reference():
    """(module, name) of every entry of the reference."""
    return [
        entry
        for page in sorted((DOCS / "reference").glob("*.md"))
        for entry in ENTRY.findall(page.read_text(encoding="utf-8"))
    ]


def public():
    """(module, name) of what the packages offer."""
    names = []
    for package in PACKAGES:
        module = importlib.import_module(f"slipcar.{package}")
        names += [(module.__name__, name) for name in module.__all__]
    return names


def thing(module, name):
    return getattr(importlib.import_module(module), name)


@pytest.mark.parametrize(("module", "name"), public())
def test_a_public_name_has_a_docstring_and_a_place(module, name):
    value = thing(module, name)
    entries = [each for each in reference() if each[1] == name]
    assert [e for e in entries if thing(*e) is value or thing(*e) == value], name
    if inspect.isclass(value) or callable(value):
        assert inspect.getdoc(value), name
    if inspect.isfunction(value):
        assert set(value.__annotations__) == {*inspect.signature(value).parameters, "return"}


@pytest.mark.parametrize(("module", "name"), reference())
def test_members_have_docstrings(module, name):
    """Methods and properties of a class in the reference, those that the class itself defines."""
    value = thing(module, name)
    members = vars(value).items() if inspect.isclass(value) else ()
    bare = [
        key
        for key, member in members
        if not key.startswith("_")
        and (inspect.isroutine(member) or isinstance(member, property))
        and not inspect.getdoc(getattr(value, key))
        and f"{key}: " not in inspect.getdoc(value)  # among its attributes
    ]
    assert bare == []


def test_what_pages_import_is_in_the_reference():
    """From slipcar, in any Python of a page; tools of the reproduction are its own."""
    known = {name for _, name in reference()}
    unknown = set()
    for page in [ROOT / "README.md", *DOCS.glob("*.md")]:
        if page.name == "reproduction.md":
            continue
        for code in re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
            if not code.startswith("--8<--"):
                unknown |= {f"{page.name}: {name}" for name in imported(code) if name not in known}
    assert unknown == set()


def imported(code):
    """Names that a script imports from slipcar."""
    return {
        alias.name
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("slipcar")
        for alias in node.names
    }


def entries(nav):
    """Pages of a part of the navigation."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in entries(part)]


def test_every_page_is_in_the_navigation():
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    there = {p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md")}
    there |= {p.relative_to(DOCS).with_suffix(".md").as_posix() for p in NOTEBOOKS}
    assert sorted(entries(site["nav"])) == sorted(there)


def test_there_are_four_notebooks():
    assert len(NOTEBOOKS) == 4


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_outputs_and_its_pictures_are_described(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert cells[0]["cell_type"] == "markdown"
    for cell in cells:
        assert not cell.get("outputs")
        assert not cell.get("execution_count")
        if "plt.show()" in "".join(cell["source"]):
            assert cell["metadata"]["alt"]


def test_observation_tables_have_every_entry():
    """Of SlipCar-v0's page: a row, or a part of one, for each number of each observation."""
    from slipcar.envs.observation import LAYOUTS

    text = (DOCS / "slipcar-v0.md").read_text(encoding="utf-8")
    for kind, layout in LAYOUTS.items():
        table = re.search(rf'^=== "{kind}.*?\n(.*?)(?=^\S|\Z)', text, re.DOTALL | re.MULTILINE)[1]
        rows = re.findall(r"^    \| ([\d, ]+) \|", table, re.MULTILINE)
        assert [int(i) for row in rows for i in row.split(",")] == list(range(len(layout)))
