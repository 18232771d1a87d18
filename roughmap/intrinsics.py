"""What LLVM can do and numba does not expose: pointers from addresses, prefetch, zero bits, calls that stay calls."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _as_pointer(typingctx: Any, address: Any, like: Any) -> Any:  # noqa: ARG001 - numba's calling convention
    """Convert an address to a pointer to values of the type of ``like``."""
    signature = types.CPointer(like)(types.uint64, like)  # type: ignore[no-untyped-call]

    def codegen(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(sig.return_type))

    return signature, codegen


pointer: Any = intrinsic(_as_pointer)


def _prefetch(typingctx: Any, address: Any) -> Any:  # noqa: ARG001 - numba's calling convention
    """Prefetch the cache line at an address for writing; has no other effect."""

    def codegen(context: Any, builder: ir.IRBuilder, _: Any, args: Any) -> Any:
        number = ir.IntType(32)
        pointer = ir.IntType(8).as_pointer()
        form = ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        name = "llvm.prefetch.p0"
        function = builder.module.globals.get(name) or ir.Function(builder.module, form, name)
        for_writing, all_levels, data_cache = number(1), number(3), number(1)
        builder.call(function, [builder.inttoptr(args[0], pointer), for_writing, all_levels, data_cache])
        return context.get_dummy_value()

    return types.void(types.uint64), codegen


prefetch: Any = intrinsic(_prefetch)


def _trailing_zeros(typingctx: Any, word: Any) -> Any:  # noqa: ARG001 - numba's calling convention
    """Count the zero bits below the lowest set bit of a word; the word must not be 0."""

    def codegen(_context: Any, builder: ir.IRBuilder, _sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.uint64(types.uint64), codegen


trailing_zeros: Any = intrinsic(_trailing_zeros)


def _never_inline(typingctx: Any) -> Any:  # noqa: ARG001 - numba's calling convention
    """Keep the function in which this stands out of its callers.

    LLVM would copy even a large kernel into the loop that calls it, and the loop would lose its registers to it.
    """

    def codegen(context: Any, builder: ir.IRBuilder, *_: Any) -> Any:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), codegen


never_inline: Any = intrinsic(_never_inline)
