"""`slipcar export`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated, Literal

import tyro

from slipcar.evaluation.commands.inputs import OwnScenarioOption, read_scenario
from slipcar.evaluation.commands.output import Output, OutputOption

_PLANS, _POLICIES = ("c", "json"), ("onnx", "torchscript")


def export(
    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLAN|POLICY")],
    *,
    to: Literal["c", "json", "onnx", "torchscript"],
    out: Path | None = None,
    law: Literal["planned", "lqr", "open-loop"] = "planned",
    float32: bool = False,
    unbounded: bool = False,
    scenario: OwnScenarioOption = None,
    output: OutputOption = Output(),  # noqa: B008  frozen
) -> int:
    """Write a plan's control law as C or JSON, or a policy as ONNX or TorchScript.

    The law is u = plan + gains (state - mean), within the bounds: a header and a source in C99
    without dependencies or allocation, and a test of both. A policy goes from time and state to
    the control: its observation is computed inside, for one world.

        slipcar plan --feedback --save plan.npz
        slipcar export plan.npz --to c --out law
        slipcar export plan.npz --to json
        slipcar export policy --to onnx
        slipcar export runs/mine --to torchscript --scenario slalom

    Calls slipcar.planner.law.Law.of, slipcar.planner.c_code.write_c and
    slipcar.baselines.deployment.export_policy.

    Args:
        source: a plan's .npz file; or a policy's .safetensors or .json file or folder; policy is
            the shipped one.
        to: what to write: c or json for a plan, onnx or torchscript for a policy.
        out: the folder for C, the file for the others; by default beside the source, or in the
            current folder, under its name.
        law: planned: the gains that the plan was planned with; lqr: those of an LQR that tracks
            it; open-loop: none.
        float32: single precision instead of double.
        unbounded: allow a plan of a problem whose controls have no bounds.
        scenario: of a policy: the world whose numbers are written.
        output: what is printed.
    """
    stored = Path(source).suffix == ".npz"
    if stored != (to in _PLANS):
        raise ValueError(
            f"a plan (.npz) is exported to {' or '.join(_PLANS)}, a policy to "
            f"{' or '.join(_POLICIES)}: not {source} to {to}"
        )
    if stored:
        if scenario is not None:
            raise ValueError("--scenario is of policies; a plan knows its own")
        return _export_plan(output, Path(source), to, out, law, float32, unbounded)
    if law != "planned" or unbounded:
        raise ValueError("--law and --unbounded are of plans, not of policies")
    return _export_policy(output, source, to, out, scenario, float32)


def _export_plan(
    output: Output,
    source: Path,
    to: str,
    out: Path | None,
    kind: str,
    float32: bool,
    unbounded: bool,
) -> int:
    from slipcar.planner import Plan
    from slipcar.planner.c_code import write_c
    from slipcar.planner.law import Law

    law = Law.of(Plan.load(source), kind, unbounded=unbounded)
    said = output.console()
    if to == "json":
        if float32:
            raise ValueError("--float32 is of C, ONNX and TorchScript; JSON has the numbers whole")
        path = source.with_suffix(".json") if out is None else out
        path.write_text(json.dumps(law.as_dict()) + "\n", encoding="ascii")
        output.data({"files": [str(path)]})
        said.print(f"law in {path}", markup=False, soft_wrap=True)
        return 0
    name = re.sub(r"\W+", "_", source.stem, flags=re.ASCII).lower().strip("_")
    name = name if name[:1].isalpha() else f"law_{name}".rstrip("_")
    written = write_c(law, source.parent if out is None else out, name, float32=float32)
    output.data({"files": [str(path) for path in written]})
    for path in written:
        said.print(f"written: {path}", markup=False, soft_wrap=True)
    said.print(f"test it: cc {name}.c {name}_test.c -o {name}_test && ./{name}_test", markup=False)
    return 0


def _export_policy(
    output: Output, source: str, to: str, out: Path | None, scenario: str | None, float32: bool
) -> int:
    from slipcar.baselines import load_policy

    policy = load_policy(None if source in ("policy", "ppo") else source)
    world = None if scenario is None else read_scenario(scenario)
    try:
        from slipcar.baselines.deployment import TARGETS, export_policy
    except ImportError as error:
        raise ImportError(f'{to} needs torch: pip install "slipcar[export]"') from error
    path = Path(Path(source).stem + TARGETS[to]) if out is None else out
    off = export_policy(policy, path, to, world, float32=float32)
    output.data({"files": [str(path)], "largest_difference": off})
    said = output.console()
    said.print(f"policy in {path}", markup=False, soft_wrap=True)
    what = "not compared: onnxruntime is not installed"
    if off is not None:
        what = f"largest difference from the original at 1000 states: {off:.1e} of the bounds"
    said.print(what, markup=False)
    return 0
