"""A section for each of the benchmark's systems, planned and drawn when the site is built.

The line `<!-- systems -->` of a page is replaced by them; the systems are benchmarks/systems.
"""

import inspect
import io
import re
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mkdocs.structure.files import File

from slipcar.planner import plan

ROOT = Path(__file__).resolve().parents[2]
MARK = "<!-- systems -->"
COLUMNS = 4
_DONE = {}


def on_files(files, config):
    """Plan and draw all systems; put their sections where the mark is."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.systems.catalogue import SYSTEMS

    for name, system in SYSTEMS.items():
        if not system.variant:
            if name not in _DONE:
                _DONE[name] = section(name, system)
            files.append(File.generated(config, f"systems/{name}.png", content=_DONE[name][1]))
    page = files.get_file_from_path("systems.md")
    text = page.content_string.replace(MARK, "\n\n".join(text for text, _ in _DONE.values()))
    files.remove(page)
    files.append(File.generated(config, page.src_uri, content=text))
    return files


def section(name, system):
    """Markdown and figure of a system."""
    problem = system.make()
    p = plan(problem, variance_weight=0.0)
    cls = type(problem)
    path = Path(inspect.getfile(cls)).relative_to(ROOT)
    text = inspect.cleandoc(cls.__doc__).split("\n\nArgs:")[0]
    what = re.sub(r"\s+", " ", text)
    controls = system.dimensions.controls.split()
    N, n = p.mean.shape
    rows = [
        ("states", f"{n}: {', '.join(units(system.dimensions.states))}"),
        ("controls", f"{len(controls)}: {', '.join(units(system.dimensions.controls))}"),
        ("bounds of the controls", bounds(problem)),
        ("horizon, nodes", f"{p.times[-1]:g}, {N}"),
        ("penalties", count(problem, p, "penalty")),
        ("chance constraints", count(problem, p, "constraint")),
        ("the plan", f"{p.status.name}, {p.iterations} iterations, cost {p.cost:.6g}"),
        ("written in", f"[`{path}`](../{path})"),
    ]
    table = "\n".join(f"| {key} | {value} |" for key, value in rows)
    alt = f"{name}: states and controls of the plan over time, with two standard deviations"
    picture = f"![{alt}](systems/{name}.png)"
    return f"### {name}\n\n{what}\n\n{picture}\n\n| | |\n|---|---|\n{table}", drawn(p)


def units(text):
    """Units in order; `1` is a number or an angle."""
    return ["–" if unit == "1" else unit for unit in text.split()]


def bounds(problem):
    """Of each control, or none."""
    limits = getattr(problem, "control_bounds", None)
    if limits is None:
        return "none"
    low, high = (-limits, limits) if np.ndim(limits) == 1 else limits
    return ", ".join(f"[{a:g}, {b:g}]" for a, b in zip(low, high, strict=True))


def count(problem, p, member):
    """How many entries a function of time and state has."""
    function = getattr(problem, member, None)
    return 0 if function is None else np.shape(function(p.times, p.mean))[-1]


def drawn(p):
    """PNG: every state with two standard deviations, every control."""
    n, m = p.mean.shape[1], p.controls.shape[1]
    high = -(-(n + m) // COLUMNS)
    figure = Figure(figsize=(10, 1.7 * high), layout="constrained")
    axes = figure.subplots(high, COLUMNS, squeeze=False).ravel()
    spread = 2.0 * np.sqrt(np.diagonal(p.covariance, axis1=1, axis2=2))
    for i in range(n):
        axes[i].fill_between(
            p.times, p.mean[:, i] - spread[:, i], p.mean[:, i] + spread[:, i], alpha=0.25
        )
        axes[i].plot(p.times, p.mean[:, i])
        axes[i].set_title(f"state {i}", fontsize=9)
    for j in range(m):
        axes[n + j].stairs(p.controls[:, j], p.times, baseline=None, color="C1")
        axes[n + j].set_title(f"control {j}", fontsize=9)
    for ax in axes[n + m :]:
        ax.set_axis_off()
    for ax in axes[: n + m]:
        ax.tick_params(labelsize=8)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=90)
    return file.getvalue()
