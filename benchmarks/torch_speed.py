"""Steps per second of the Torch backend on one device.

    python benchmarks/torch_speed.py --device cuda --paths 1000000

prints one line of JSON. A step is one control interval of one car, its noise drawn on the device
included; the fleet's steps include observations, costs and new episodes, actions are drawn
beforehand. On a processor one thread does all. `--eager` leaves torch.compile out.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from slipcar.envs import Scenario
from slipcar.envs.torch_paths import draw_noise, path_costs
from slipcar.envs.torch_vector import SlipCarTorchEnv

WORLD = Scenario.named("paper")
STEPS = WORLD.nodes - 1


def rows(
    device: str = "cpu",
    paths: int = 2**16,
    seconds: float = 3.0,
    ways: tuple[bool, ...] = (False, True),
) -> list[dict[str, Any]]:
    """One row for each thing measured, in the given ways: eager (False), compiled (True)."""
    torch.set_num_threads(1)
    table = []
    for source in ("paper", "family:random"):
        for fused in ways:
            envs = SlipCarTorchEnv(paths, source, device=device, seed=0, compile=fused)
            envs.reset()
            actions = 2.0 * torch.rand(paths, 2, device=device) - 1.0
            what = f"SlipCarTorchEnv, {source}, {envs.layout.size} features"
            found = rate(lambda e=envs, a=actions: episode(e, a), paths, device, seconds)
            table.append(row(what, fused, found))
    luck = torch.Generator(device).manual_seed(0)
    controls = torch.tensor([0.3, 0.5], device=device).repeat(STEPS, 1)

    def drive(fused: bool, count: int = paths, grad: bool = False) -> None:
        u = controls.clone().requires_grad_(grad)
        noise = draw_noise(WORLD, count, seed=luck, device=device)
        with torch.set_grad_enabled(grad):
            total = path_costs(WORLD, u, noise, compile=fused).total.mean()
            if grad:
                total.backward()

    for fused in ways:
        found = rate(lambda f=fused: drive(f), paths, device, seconds)
        table.append(row("paths and their costs", fused, found))
    some = min(paths, 2**16)  # what the way back needs is kept: some 200 bytes a step
    found = rate(lambda: drive(False, some, True), some, device, seconds)
    return [*table, row(f"gradient of the mean cost, {some} paths", False, found)]


def episode(envs: SlipCarTorchEnv, actions: torch.Tensor) -> None:
    for _ in range(STEPS):
        envs.step(actions)


def row(what: str, fused: bool, found: float) -> dict[str, Any]:
    return {"what": what, "dtype": "float32", "compiled": fused, "steps/s": found}


def rate(run: Callable[[], None], paths: int, device: str, seconds: float) -> float:
    """Steps per second of `run`, which drives all paths once; two runs to warm up."""

    def wait() -> None:
        if torch.device(device).type == "cuda":
            torch.cuda.synchronize()

    for _ in range(2):
        run()
    wait()
    count, began = 0, time.perf_counter()
    while count == 0 or time.perf_counter() - began < seconds:
        run()
        wait()
        count += 1
    return count * STEPS * paths / (time.perf_counter() - began)


def name_of(device: str) -> str:
    """The device in words."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, one thread"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu", help="anything torch.device takes")
    parser.add_argument("--paths", type=int, default=2**16, help="how many cars")
    parser.add_argument("--seconds", type=float, default=3.0, help="to measure each row")
    parser.add_argument("--eager", action="store_true", help="without torch.compile")
    given = parser.parse_args()
    ways = (False,) if given.eager else (False, True)
    table = rows(given.device, given.paths, given.seconds, ways)
    about = {"device": name_of(given.device), "torch": torch.__version__, "paths": given.paths}
    print(json.dumps({**about, "rows": table}))


if __name__ == "__main__":
    main()
