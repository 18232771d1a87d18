"""LLVM instructions that numba has no name for: addresses as pointers, and a prefetch."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _as_pointer(typingctx: Any, address: Any, like: Any) -> Any:  # noqa: ARG001 - numba's calling form
    """An address as a pointer to values of the type of ``like``."""
    signature = types.CPointer(like)(types.uint64, like)  # type: ignore[no-untyped-call]

    def codegen(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(sig.return_type))

    return signature, codegen


pointer: Any = intrinsic(_as_pointer)


def _fetch(typingctx: Any, address: Any) -> Any:  # noqa: ARG001 - numba's calling form
    """Ask for the cache line at an address, to be written soon; changes nothing."""

    def codegen(context: Any, builder: ir.IRBuilder, _: Any, args: Any) -> Any:
        number = ir.IntType(32)
        pointer = ir.IntType(8).as_pointer()
        form = ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        ask = builder.module.globals.get("llvm.prefetch.p0") or ir.Function(builder.module, form, "llvm.prefetch.p0")
        to_write, keep, data = number(1), number(3), number(1)
        builder.call(ask, [builder.inttoptr(args[0], pointer), to_write, keep, data])
        return context.get_dummy_value()

    return types.void(types.uint64), codegen


prefetch: Any = intrinsic(_fetch)
