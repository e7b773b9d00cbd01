"""The package as a thing: what it contains, what it needs, and what importing it costs.

Which file may import which: see test_house.py.
"""

import ast
import importlib
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NAMES = {"envs", "planner", "baselines", "evaluation"}
# What no plan needs, or not until it is asked for.
HEAVY = ["torch", "gymnasium", "matplotlib", "pandas", "osqp", "cvxpy"]


#: The folder of `slipcar` itself: one file, which imports nothing.
TOP = "package"


def sources():
    """Python files of the package and its four parts."""
    return sorted(path for part in (TOP, *NAMES) for path in (ROOT / part).rglob("*.py"))


def folders():
    """Every folder with an `__init__.py`: the module that it should be -> the folder."""
    inits = [path.parent.relative_to(ROOT) for path in sources() if path.name == "__init__.py"]
    return {
        "slipcar" if path.name == TOP else f"slipcar.{'.'.join(path.parts)}": path.as_posix()
        for path in inits
    }


def wanted(source):
    """Top-level names that a source imports absolutely, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add(node.module.split(".")[0])
    return names


def run(code, python=sys.executable):
    """The output of a fresh interpreter."""
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, cwd="/")
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- what importing costs ------------------------------------------------------------------


def test_importing_the_planner_imports_nothing_heavy():
    loaded = run("import sys, slipcar.planner; print(*sys.modules)").split()
    assert "slipcar.planner.convex.iteration" in loaded
    assert not {name.split(".")[0] for name in loaded} & set(HEAVY)


def test_importing_the_planner_takes_less_than_half_a_second():
    """The one timing among the tests: an interpreter that starts, imports and ends.

    In seconds of the processor: those of the clock belong to whatever else runs.
    """

    def seconds():
        before = os.times()
        run("import slipcar.planner")
        after = os.times()
        return (after.children_user - before.children_user) + (
            after.children_system - before.children_system
        )

    assert min(seconds() for _ in range(3)) < 0.5


WITHOUT_EXTRAS = """
import sys
for name in {missing}:
    sys.modules[name] = None    # importing it raises ImportError

import gymnasium as gym
from slipcar.envs import Scenario
from slipcar.planner import Feedback, OpenLoop, Status, plan

scenario = Scenario.named("paper")
p = plan(scenario)
assert p.status is Status.CONVERGED, p.status
env = gym.make("slipcar.envs:SlipCar-v0", scenario="paper")
for controller in OpenLoop(p), Feedback(p){policy}:
    observation, _ = env.reset(seed=0)
    done, steps = False, 0
    while not done:
        action, _ = controller.predict(observation)
        observation, _, done, _, info = env.step(action)
        steps += 1
    assert steps == scenario.nodes - 1
print("drove")
"""
EXTRAS = sorted(
    {
        *["torch", "stable_baselines3", "tensorboard", "tqdm", "matplotlib", "PIL", "pygame"],
        *["osqp", "cvxpy", "clarabel", "casadi"],
    }
)


def test_planning_and_driving_need_no_extra():
    assert run(WITHOUT_EXTRAS.format(missing=EXTRAS, policy="")) == "drove\n"


def test_the_shipped_policy_needs_no_extra():
    policy = ', __import__("slipcar.baselines").baselines.load_policy()'
    assert run(WITHOUT_EXTRAS.format(missing=EXTRAS, policy=policy)) == "drove\n"


def test_the_planner_needs_nothing_but_numpy_and_scipy_to_plan_slowly():
    """Without llvmlite it says so, once, and takes the same steps."""
    missing = sorted({*HEAVY, *EXTRAS, "llvmlite"})
    code = (
        f"import sys\nfor name in {missing}:\n    sys.modules[name] = None\n"
        "import numpy as np\n"
        "class Cart:\n"
        "    start, times, control_weight = np.zeros(2), np.linspace(0.0, 1.0, 11), np.eye(1)\n"
        "    drift = lambda self, t, x, u: np.stack([x[..., 1], u[..., 0]], axis=-1)\n"
        "    diffusion = lambda self, t, x: 0.1 * np.ones((*x.shape, 1))\n"
        "    terminal = lambda self, x: x - np.array([1.0, 0.0])\n"
        "from slipcar.planner import plan\n"
        "print(*(plan(Cart()).status.name for _ in range(2)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd="/")
    assert done.stdout == "CONVERGED CONVERGED\n", done.stderr
    assert done.stderr.count("llvmlite is missing") == 1


# --- what it needs ------------------------------------------------------------------------


def test_whatever_is_imported_is_declared():
    project = PYPROJECT["project"]
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    declared = {_distribution(line) for line in project["dependencies"] + extras}
    providers = importlib.metadata.packages_distributions()
    for path in sources():
        for top in wanted(path.read_text(encoding="utf-8")):
            if top in sys.stdlib_module_names or top == "slipcar":
                continue
            candidates = {_distribution(provider) for provider in providers.get(top, [top])}
            assert candidates & declared, f"{path.relative_to(ROOT)} imports {top}, undeclared"


def _distribution(requirement):
    """The normalised name in `Some_name>=1.0`."""
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


# --- what it says it is --------------------------------------------------------------------


def test_every_folder_is_listed():
    setup = PYPROJECT["tool"]["setuptools"]
    assert set(setup["packages"]) == set(folders())
    assert setup["package-dir"] == folders()
    assert set(PYPROJECT["tool"]["mypy"]["packages"]) == {f"slipcar.{name}" for name in NAMES}


@pytest.mark.parametrize("name", sorted(NAMES))
def test_is_typed(name):
    assert (Path(importlib.import_module(f"slipcar.{name}").__path__[0]) / "py.typed").is_file()


def test_one_version_everywhere():
    version = PYPROJECT["project"]["version"]
    assert importlib.metadata.version("slipcar") == version
    assert importlib.import_module("slipcar").__version__ == version
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(\d[^]]*)\]", changelog, re.MULTILINE)[0] == version


def test_every_pin_satisfies_what_is_asked_for():
    from packaging.requirements import Requirement

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    pins = {_distribution(name): version for name, version in pins.items()}
    assert pins["torch"] == "2.13.0"  # any build of it: no local version
    assert "slipcar" not in pins
    project, groups = PYPROJECT["project"], PYPROJECT["dependency-groups"]
    asked = [*project["dependencies"], *groups["dev"]]
    asked += [line for lines in project["optional-dependencies"].values() for line in lines]
    for requirement in map(Requirement, asked):
        if requirement.name != "slipcar":
            assert pins[_distribution(requirement.name)] in requirement.specifier, requirement


def test_a_saved_plan_finds_its_problem():
    (entry,) = importlib.metadata.entry_points(group="slipcar.problems", name="Scenario")
    scenario = entry.load().named("paper")
    assert entry.load().from_json(scenario.to_json()) == scenario


def test_the_command_answers():
    script = Path(sys.executable).with_name("slipcar")
    done = subprocess.run([script, "--help"], capture_output=True, text=True, cwd="/")
    assert done.returncode == 0, done.stderr
    commands = ("compare", "frontier", "plan", "simulate", "train")
    assert all(command in done.stdout for command in commands)


# --- what is shipped -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel built from a copy, so that nothing left in the checkout's build/ gets into it."""
    checkout = tmp_path_factory.mktemp("checkout")
    ignore = shutil.ignore_patterns("__pycache__")
    for name in (TOP, *NAMES):
        shutil.copytree(ROOT / name, checkout / name, ignore=ignore)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, checkout)
    shutil.copytree(ROOT / "tests" / "data", checkout / "tests")  # something not to be shipped
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "."]
    done = subprocess.run(command, capture_output=True, text=True, cwd=checkout)
    assert done.returncode == 0, done.stderr
    (path,) = checkout.glob("slipcar-*.whl")
    return path


@pytest.fixture(scope="module")
def shipped(wheel):
    """Name -> bytes of each file in the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_the_wheel_holds_the_package_and_nothing_else(shipped):
    kept = {".py", ".typed", ".html", ".css", ".js"}
    expected = {
        f"slipcar/{path.relative_to(ROOT).as_posix().removeprefix(f'{TOP}/')}"
        for name in (TOP, *NAMES)
        for path in (ROOT / name).rglob("*")
        if path.suffix in kept or ("weights" in path.parts and path.is_file())
    }
    assert {name for name in shipped if ".dist-info/" not in name} == expected


def test_the_wheel_carries_the_shipped_policy(shipped):
    weights = {Path(name).name for name in shipped if "/weights/" in name}
    assert {"ppo-0.json", "ppo-0.safetensors"} <= weights


def test_the_wheel_knows_its_licence_and_entry_points(shipped):
    info = f"slipcar-{PYPROJECT['project']['version']}.dist-info"
    assert shipped[f"{info}/licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes()
    entries = shipped[f"{info}/entry_points.txt"].decode()
    assert "[console_scripts]\nslipcar = slipcar.evaluation.cli:main" in entries
    assert "[slipcar.problems]\nScenario = slipcar.envs.scenario:Scenario" in entries


@pytest.mark.long
def test_the_wheel_works_without_extras(wheel, tmp_path):
    """Installed alone in a new environment, which needs the network."""
    subprocess.run([sys.executable, "-m", "venv", tmp_path], check=True)
    python = tmp_path / "bin" / "python"
    pins = ROOT / "constraints.txt"
    subprocess.run([python, "-m", "pip", "-q", "install", "-c", pins, wheel], check=True)
    find = "from importlib.util import find_spec; print([n for n in {} if find_spec(n)])"
    assert run(find.format(EXTRAS), python) == "[]\n"
    policy = ', __import__("slipcar.baselines").baselines.load_policy()'
    assert run(WITHOUT_EXTRAS.format(missing=[], policy=policy), python) == "drove\n"


# --- what a user's type checker sees -------------------------------------------------------


RIGHT = (ROOT / "tests" / "typing" / "user_script.py").read_text(encoding="utf-8")
WRONG = """
class Unfinished:
    pass

wrong: int = p.effort  # error
plan(Unfinished())  # error
plan(scenario, method="Newton")  # error
plan(scenario, solver="ipopt")  # error
plan(scenario, trust_region="large")  # error
plan(scenario, cold_start="never ever")  # error
plan_batch([scenario], integrator="heun")  # error
scenario.times = p.times  # error
slipcar.__version__ + 1  # error
"""


def mypy_errors(script):
    """Line numbers of what mypy says, by the project's settings: `make lint` fills their cache."""
    done = subprocess.run(
        [sys.executable, "-m", "mypy", script], capture_output=True, text=True, cwd=ROOT
    )
    found = re.findall(rf"{script.name}:(\d+): error", done.stdout)
    assert found or "Success" in done.stdout, done.stdout + done.stderr
    return sorted({int(line) for line in found})


def pyright_errors(script):
    """Line numbers of what pyright says, in its usual mode."""
    above = Path(importlib.import_module("slipcar.planner").__path__[0]).parents[1]
    settings = {"include": [script.name], "typeCheckingMode": "standard"}
    config = script.with_name("pyrightconfig.json")
    config.write_text(json.dumps(settings | {"extraPaths": [str(above)]}), encoding="utf-8")
    command = [Path(sys.executable).with_name("basedpyright"), "-p", config, "--outputjson"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=script.parent)
    said = json.loads(done.stdout)
    assert said["summary"]["filesAnalyzed"] == 1, done.stdout
    return sorted({each["range"]["start"]["line"] + 1 for each in said["generalDiagnostics"]})


@pytest.mark.parametrize("errors", [mypy_errors, pyright_errors])
def test_a_users_type_checker_sees_the_types(tmp_path, errors):
    """A script elsewhere: what is right is accepted, and each wrong line is found, none else."""
    script = tmp_path / "user.py"
    script.write_text(RIGHT, encoding="utf-8")
    assert errors(script) == []
    script.write_text(RIGHT + WRONG, encoding="utf-8")
    wrong = (RIGHT + WRONG).splitlines()
    assert errors(script) == [i for i, line in enumerate(wrong, 1) if line.endswith("# error")]
