"""The one way in which kernels are compiled."""

import hashlib
import inspect
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, InTreeCacheLocator

F = TypeVar("F", bound=Callable[..., object])


@cache
def _stamp(folder: Path) -> str:
    """A digest of the sources in a folder and of this package's, of which kernels there may be made."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for path in sorted({*folder.glob("*.py"), *package.rglob("*.py")}):
        name = path.relative_to(package) if path.is_relative_to(package) else path.name
        digest.update(str(name).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


class _BesideTheSource(InTreeCacheLocator):
    """The folder beside the sources, writable or not: the last resort."""

    def ensure_cache_path(self) -> None:
        """Take it as it is."""


class _Locating(CompileResultCacheImpl):
    _locator_classes = [*CompileResultCacheImpl._locator_classes, _BesideTheSource]  # noqa: RUF012 - numba's own form


class _KernelFiles(IndexDataCacheFile):
    """Compiled kernels of one function: those beside the source, then those in the folder that can be written.

    An image brings its kernels beside the sources, where its user can't write. On another CPU than they were made for,
    others are compiled, and kept in NUMBA_CACHE_DIR if there is one; else they last as long as the process.
    """

    def __init__(self, folder: str, beside: str, name: str, stamp: str) -> None:
        super().__init__(cache_path=folder, filename_base=name, source_stamp=stamp)  # type: ignore[no-untyped-call]
        self._shipped = IndexDataCacheFile(cache_path=beside, filename_base=name, source_stamp=stamp)  # type: ignore[no-untyped-call]

    def load(self, key: object) -> Any:
        """The kernel's data, or None."""
        return self._shipped.load(key) or super().load(key)  # type: ignore[no-untyped-call]

    def save(self, key: object, data: object) -> None:
        """Keep a kernel where that is possible; it works without, too."""
        with suppress(OSError):
            super().save(key, data)  # type: ignore[no-untyped-call]


class _PackageCache(FunctionCache):
    """Compiled kernels on disk, good while no source has changed of which they may be made.

    numba looks at the file of the kernel alone, but helpers from other files are compiled into it: after an upgrade
    that changed only such a file, the old kernels would go on beside the new ones.
    """

    _impl_class = _Locating

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        source = Path(inspect.getfile(function)).resolve()
        self._cache_file = _KernelFiles(
            folder=self._cache_path,
            beside=str(source.parent / "__pycache__"),
            name=self._impl.filename_base,
            stamp=_stamp(source.parent),
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
