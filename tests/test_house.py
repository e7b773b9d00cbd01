"""The house: which file may import which, and how a file of the planner may look.

Imports count wherever they stand: inside functions, under TYPE_CHECKING, and as a name handed to
`import_module`.
"""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "envs": {"envs"},
    "planner": {"planner"},
    "baselines": {"baselines", "envs", "planner"},
    "evaluation": {"evaluation", "baselines", "envs", "planner"},
}

# What users import and what they get back; its records are known to all rooms but `trace`.
RECORDS = {"status", "options", "records", "outcome", "actuation", "display"}
HALL = {
    "__init__", "planning", "plan", "batch", "receding_horizon", "control_loop", "controllers",
    "plan_file", "export", "law", "c_code",
}  # fmt: skip
# Room -> the rooms below it, which it may import.
GROUND = {"problem", "trace"}
ROOMS = {
    "trace": set(),
    "problem": {"trace"},
    "lq": GROUND,
    "moments": GROUND,
    "newton": {"lq", "moments"} | GROUND,
    "convex": {"lq", "moments"} | GROUND,
    "extremal": {"lq", "moments"} | GROUND,
    "search": {"newton", "convex", "extremal", "lq", "moments"} | GROUND,
}
# The one door between rooms of the same floor: shooting starts from a convex sub-problem.
DOORS = {("extremal", "slipcar.planner.convex.subproblem")}
LONGEST = 80
# The fourth of something is what nobody remembers; an array's axes are numbers by nature.
LARGEST_INDEX, NUMBERED = 2, {"shape", "strides", "Literal"}


# --- reading the files ---------------------------------------------------------------------


def modules(root, prefix):
    """Dotted name -> file of every module below `root`, which is the package `prefix`."""
    found = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join([prefix, *parts]).removesuffix(".__init__")] = path
    return found


def house(*packages):
    """All modules of our packages."""
    found = {}
    for name in packages or PACKAGES:
        found |= modules(ROOT / name, f"slipcar.{name}")
    return found


def imported(source, package=""):
    """Dotted names that a source imports, anywhere in it.

    Relative ones are resolved against `package`, the module's own package.
    """
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*(above if node.level else []), *filter(None, [node.module])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and called(node.func) in {"import_module", "__import__"}:
            names |= {
                each.value
                for each in node.args
                if isinstance(each, ast.Constant) and isinstance(each.value, str)
            }
    return names


def called(node):
    """The last part of a dotted name: `c` of a.b.c."""
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", None)


def imports_of(files):
    """Module -> those of `files` that it imports."""
    graph = {}
    for module, path in files.items():
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        targets = imported(path.read_text(encoding="utf-8"), package)
        graph[module] = {known(target, files) for target in targets} - {module, None}
    return graph


def known(target, files):
    """The module that holds `target`: a.b for a.b.function, None if it is not among `files`."""
    while target and target not in files:
        target = target.rpartition(".")[0]
    return target or None


def listed(found):
    """All of it, a line each: pytest would cut it short."""
    return "".join(f"\n  {name}: {', '.join(map(str, each))}" for name, each in found.items())


# --- no cycles -----------------------------------------------------------------------------


def cycles(graph):
    """Groups of modules that import each other, directly or by way of others."""

    def reached(start):
        seen, rest = set(), [*graph[start]]
        while rest:
            module = rest.pop()
            if module not in seen:
                seen.add(module)
                rest += graph[module]
        return seen

    reach = {module: reached(module) for module in graph}
    groups = {
        frozenset(other for other in reach[module] if module in reach[other])
        for module in graph
        if module in reach[module]
    }
    return sorted(sorted(group) for group in groups)


@pytest.mark.parametrize("name", PACKAGES)
def test_no_files_import_each_other(name):
    found = cycles(imports_of(house()))
    assert not [group for group in found if any(m.split(".")[1] == name for m in group)]


ROUND = {
    "__init__": "from made_up.last import last",
    "first": "def f():\n    from made_up.second import g\n    return g",
    "second": (
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from made_up.room.third import Third\n"
    ),
    "room/__init__": "",
    "room/third": "from .. import first",
    "last": "import made_up.second as second, numpy",
}


def made_up(folder, changes=()):
    """The modules of a package that is written for the purpose."""
    for name, text in (ROUND | dict(changes)).items():
        path = folder / "made_up" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return modules(folder / "made_up", "made_up")


def test_a_cycle_is_found_whatever_hides_it(tmp_path):
    around = ["made_up.first", "made_up.room.third", "made_up.second"]
    assert cycles(imports_of(made_up(tmp_path))) == [around]


@pytest.mark.parametrize(
    ("name", "text", "length"),
    [
        ("room/third", "", 0),
        ("first", "", 0),
        ("room/third", "import importlib\nimportlib.import_module('made_up.first')", 3),
        ("room/third", "from made_up import first as one", 3),
        ("room/third", "import made_up", 4),  # by way of the package: all but `first`
        ("second", "import made_up.first", 2),
        ("room/third", "from ..first import f", 3),
        ("room/third", "from .third import x", 0),
        ("room/third", "'made_up.first'", 0),
    ],
)
def test_a_cycle_goes_where_an_import_goes(tmp_path, name, text, length):
    found = cycles(imports_of(made_up(tmp_path, {name: text})))
    assert [len(group) for group in found] == ([length] if length else [])


# --- packages one way ----------------------------------------------------------------------


def forbidden(name, source):
    """Imports in a module of `slipcar.<name>` that break the order of the packages."""
    broken = set()
    for target in imported(source, f"slipcar.{name}"):
        top, _, rest = target.partition(".")
        bare = top in PACKAGES
        if bare or (top == "slipcar" and rest.split(".")[0] not in PACKAGES[name]):
            broken.add(target)
    return broken


@pytest.mark.parametrize("name", PACKAGES)
def test_packages_import_one_way(name):
    files = house(name)
    assert files
    broken = {
        module: found
        for module, path in files.items()
        if (found := forbidden(name, path.read_text(encoding="utf-8")))
    }
    assert not broken, listed(broken)


@pytest.mark.parametrize(
    ("name", "source", "broken"),
    [
        ("planner", "from slipcar.envs import Scenario", {"slipcar.envs.Scenario"}),
        ("planner", "from slipcar.planner import plan", set()),
        ("planner", "def f():\n    import slipcar.envs.car as car", {"slipcar.envs.car"}),
        ("planner", "from slipcar import envs", {"slipcar.envs"}),
        ("planner", "from ..envs import car", {"slipcar.envs.car"}),
        ("planner", "from .scp import solve\nfrom . import plan", set()),
        ("envs", "import slipcar.planner", {"slipcar.planner"}),
        ("baselines", "from slipcar.envs import car\nimport slipcar.planner", set()),
        ("baselines", "from slipcar.evaluation import rollout", {"slipcar.evaluation.rollout"}),
        ("evaluation", "import slipcar.baselines, slipcar.envs, numpy", set()),
        ("evaluation", "import envs.car", {"envs.car"}),
        ("evaluation", "from planner import plan", {"planner.plan"}),
    ],
)
def test_the_guard_of_packages_sees(name, source, broken):
    assert forbidden(name, source) == broken


# --- the planner's rooms -------------------------------------------------------------------


def place(module):
    """Where a module of the planner is: a room, or its own name if it is in the hall."""
    parts = module.split(".")
    return parts[2] if len(parts) > 2 else "__init__"


def allowed(importer, target):
    """Whether one module of the planner may import another."""
    here, there = place(importer), place(target)
    if here == there or here in HALL:
        return True
    if here in RECORDS:  # they are what comes in and out, and know no one who makes it
        return there in RECORDS or there in ROOMS.keys() - {"search"}
    if here == "trace":
        return False
    return there in RECORDS | ROOMS.get(here, set()) or (here, target) in DOORS


@pytest.mark.parametrize("name", [*ROOMS, "the hall"])
def test_rooms_import_one_way(name):
    graph = imports_of(house("planner"))
    here = HALL | RECORDS if name == "the hall" else {name}
    broken = {
        module: found
        for module, targets in graph.items()
        if place(module) in here
        and (found := sorted(target for target in targets if not allowed(module, target)))
    }
    assert not broken, listed(broken)


@pytest.mark.parametrize(
    ("importer", "target", "may"),
    [
        ("planning", "search.starts", True),
        ("planning", "trace.graph", True),
        ("search.starts", "newton.loop", True),
        ("search.starts", "planning", False),
        ("search.starts", "plan", False),
        ("newton.loop", "lq.banded", True),
        ("newton.loop", "newton.kernels", True),
        ("newton", "records", True),
        ("newton.loop", "search.starts", False),
        ("newton.loop", "convex.iteration", False),
        ("newton.loop", "extremal", False),
        ("convex.iteration", "newton", False),
        ("extremal.shooting", "convex.subproblem", True),
        ("extremal.shooting", "convex.iteration", False),
        ("extremal.shooting", "convex", False),
        ("extremal.shooting", "plan", False),
        ("lq.banded", "moments.belief", False),
        ("moments.belief", "problem.model", True),
        ("moments.belief", "newton.model", False),
        ("problem.model", "moments", False),
        ("problem.model", "trace.graph", True),
        ("problem.checks", "status", True),
        ("trace.graph", "trace.expression", True),
        ("trace.graph", "problem.model", False),
        ("trace.graph", "status", False),
        ("outcome", "records", True),
        ("outcome", "moments", True),
        ("outcome", "plan", False),
        ("options", "search.risk", False),
        ("attic.loop", "lq", False),
        ("newton.loop", "attic", False),
    ],
)
def test_the_guard_of_rooms_sees(importer, target, may):
    assert allowed(f"slipcar.planner.{importer}", f"slipcar.planner.{target}") is may


def test_the_planner_is_its_hall_and_its_rooms():
    folder = ROOT / "planner"
    assert not {path.stem for path in folder.glob("*.py")} - HALL - RECORDS
    assert {path.parent.name for path in folder.glob("*/__init__.py")} == set(ROOMS)


def test_files_that_differ_have_different_names():
    count = Counter(path.stem for path in house("planner").values())
    assert not sorted(name for name, times in count.items() if times > 1 and name != "__init__")


# --- how a file of the planner may look ----------------------------------------------------


def long_functions(source, longest):
    """Name -> lines of the functions that are longer, from `def` to the end."""
    return {
        node.name: lines
        for node in ast.walk(ast.parse(source))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and (lines := node.end_lineno - node.lineno + 1) > longest
    }


def nameless(source):
    """What a reader must count to understand: `at[14]`, `best[3]`, and any entry of `addresses`.

    An index that is one number, and larger than two. Indices of several axes (`x[..., 3]`), slices,
    and those from the end are how arrays are written.
    """
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Subscript):
            continue
        name, index = called(node.value), node.slice
        number = isinstance(index, ast.Constant) and type(index.value) is int
        counted = number and index.value > LARGEST_INDEX and name not in NUMBERED
        if counted or name == "addresses":
            found.append((node.lineno, ast.unparse(node)))
    return [text for _, text in sorted(found)]


def offences(check):
    """File of the planner -> what `check` finds in its source."""
    return {
        str(path.relative_to(ROOT)): found
        for path in house("planner").values()
        if (found := check(path.read_text(encoding="utf-8")))
    }


def test_no_function_of_the_planner_is_longer_than_a_screen_or_two():
    found = offences(lambda source: long_functions(source, LONGEST))
    assert not found, listed({path: each.items() for path, each in found.items()})


def test_nothing_in_the_planner_is_known_by_its_number():
    found = offences(nameless)
    assert not found, listed(found)


def test_a_long_function_is_found():
    source = (
        'class A:\n    @staticmethod\n    async def f(x):\n        """Twice."""\n        return 2\n'
    )
    assert long_functions(source, 2) == {"f": 3}
    assert long_functions(source, 3) == {}


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("x, values = at[14], at[19]", ["at[14]", "at[19]"]),
        ("if at[19][5] > tol: pass", ["at[19]", "at[19][5]"]),
        ("new[14][k + 1, i] = 0.0", ["new[14]"]),
        ("work = workspace(0 if addresses[6] else K)", ["addresses[6]"]),
        ("call(self.addresses[key], 0)", ["self.addresses[key]"]),
        ("return (best[2] if best[0] < 1.0 else None), best[3]", ["best[3]"]),
        ("del self.seen[3]", ["self.seen[3]"]),
        ("f(x)[3]", ["f(x)[3]"]),
        ("a[0], a[1], a[2], a[-1], a[-4]", []),
        ("x[..., 3], x[:, 3:5], x[3:], x[:3], x[3, 4], x[None, 3]", []),
        ("x[k], x[k + 3], x[3 * k], flags[True], names['four']", []),
        ("x.shape[3], x.strides[4]", []),
        ("def f(order: Literal[4]) -> tuple[int, ...]: ...", []),
        ("addresses = [1]\nfor address in addresses: ...", []),
    ],
)
def test_what_is_known_by_its_number_is_found(source, found):
    assert nameless(source) == found
