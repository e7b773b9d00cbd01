"""Calling compiled code by its address from inside numba, and the processor's clock."""

from __future__ import annotations

import platform
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_WORD = ir.IntType(64)
#: Elsewhere reading the cycle counter may be a privileged instruction.
_HAS_CYCLES = platform.machine().lower() in {"x86_64", "amd64", "i386", "i686"}


def _call(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call `void f(int64, ...)` at an address with a tuple of int64: see codegen.llvm."""
    signature = types.void(address, arguments)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        where, packed = values
        count = len(signature.args[1])
        function = ir.FunctionType(ir.VoidType(), [_WORD] * count)
        pointer = builder.inttoptr(where, function.as_pointer())
        builder.call(pointer, [builder.extract_value(packed, i) for i in range(count)])
        return context.get_dummy_value()

    return signature, generate


def _ticks(typing_context: Any) -> Any:
    """The processor's cycle counter, or the C library's clock: to share out a measured time."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = ir.FunctionType(_WORD, [])
        if _HAS_CYCLES:
            function = builder.module.declare_intrinsic("llvm.readcyclecounter", fnty=kind)
        else:
            function = cgutils.get_or_insert_function(builder.module, kind, "clock")
        return builder.call(function, [])

    return types.int64(), generate


#: As callables of any arguments: what type checkers see of `intrinsic` is what it wraps.
call: Any = intrinsic(_call)
ticks: Any = intrinsic(_ticks)
