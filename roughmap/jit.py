"""The one way in which kernels are compiled."""

import hashlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

F = TypeVar("F", bound=Callable[..., object])


@cache
def _stamp(folder: Path) -> str:
    """A digest of the sources in a folder and of this package's, of which kernels there may be made."""
    digest = hashlib.sha256()
    for path in sorted({*folder.glob("*.py"), *Path(__file__).resolve().parent.glob("*.py")}):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


class _PackageCache(FunctionCache):
    """Compiled kernels on disk, good while no source has changed of which they may be made.

    numba looks at the file of the kernel alone, but helpers from other files are compiled into it: after an upgrade
    that changed only such a file, the old kernels would go on beside the new ones.
    """

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file = IndexDataCacheFile(  # type: ignore[no-untyped-call]
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=_stamp(Path(inspect.getfile(function)).resolve().parent),
        )


def _compile(function: F, **options: Any) -> F:
    compiled = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if hasattr(compiled, "enable_caching"):  # not with NUMBA_DISABLE_JIT: then it is the plain function
        compiled._cache = _PackageCache(function)
    result: F = compiled
    return result


def kernel(function: F) -> F:
    """Compile ``function`` with numba.

    Without the GIL, cached on disk, and with IEEE division: a Python zero-division check in a loop keeps it from
    being vectorised. ``fastmath`` stays off, so that the same source gives the same bits on every machine.
    """
    return _compile(function)


def inline(function: F) -> F:
    """The same for small helpers that are always inlined into a kernel by LLVM."""
    return _compile(function, inline="never", forceinline=True)
