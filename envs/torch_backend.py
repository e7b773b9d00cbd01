"""What the Torch faces share: the package where it is installed, devices, numbers on a device.

Torch is imported when one of them is used, so `import slipcar.envs` does without it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.extras import install

if TYPE_CHECKING:
    import torch

DTYPES = ("float32", "float64")


def torch_module() -> Any:
    """The package `torch`.

    Raises:
        ImportError: if it is not installed, naming the extra that brings it.
    """
    try:
        import torch
    except ImportError as error:
        raise ImportError(f"this needs PyTorch ({error}): {install('rl')}") from error
    return torch


def checked_device(device: Any) -> torch.device:
    """The device, if this machine has it.

    Raises:
        ValueError: for an unknown or an absent one, listing those that are there.
        ImportError: if PyTorch is not installed.
    """
    torch = torch_module()
    try:
        found = torch.device(device)
        if found.type == "meta":
            raise RuntimeError("it holds no numbers")
        torch.empty(1, device=found)
    # Torch built without CUDA raises AssertionError, other backends NotImplementedError.
    except (RuntimeError, TypeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"device {device!r} cannot be used here ({reason}); available are {devices()}"
        ) from None
    return found


def devices() -> list[str]:
    """Devices that this machine has, the processor first."""
    torch = torch_module()
    there = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        there.append("mps")
    return there


def checked_dtype(dtype: Any) -> torch.dtype:
    """`float32` or `float64`, as Torch's own, from that or from a name.

    Raises:
        ValueError: for anything else.
    """
    torch = torch_module()
    allowed = {getattr(torch, name): name for name in DTYPES}
    for found, name in allowed.items():
        if dtype is found or (isinstance(dtype, str) and dtype == name):
            return found
    raise ValueError(f"unknown dtype {dtype!r}; allowed are {list(DTYPES)}")


def dtype_of_network(network: Any) -> torch.dtype | None:
    """The dtype that a network's parameters have, the first that is real; None without any.

    It need not be that of an observation: with `torch.set_default_dtype(torch.float64)` it is not.
    """
    if not isinstance(network, torch_module().nn.Module):
        return None
    return next((p.dtype for p in network.parameters() if p.is_floating_point()), None)


def tensor(values: Any, device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """A copy of an array on a device."""
    torch = torch_module()
    # First the dtype: not every device has float64.
    return torch.from_numpy(np.array(values, dtype=np.float64)).to(dtype).to(device)


def compiled(function: Callable[..., Any], device: torch.device) -> Callable[..., Any]:
    """The function fused into few kernels by `torch.compile`.

    Raises:
        RuntimeError: if that does not work on this machine, with its reason.
    """
    torch = torch_module()
    try:
        # So small a thing shows whether there is a compiler at all.
        torch.compile(_probe)(torch.zeros(8, device=device))
    except Exception as error:
        reason = str(error).strip().splitlines()[0]
        raise RuntimeError(
            f"torch.compile does not work here for device {str(device)!r} ({reason}): it needs a "
            "C++ compiler for 'cpu' and Triton for 'cuda'; compile=False does without"
        ) from error
    return torch.compile(function, fullgraph=True)


def _probe(x: torch.Tensor) -> torch.Tensor:
    return x * x + 1.0
