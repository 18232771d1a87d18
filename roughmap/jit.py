"""Compilation of kernels with numba, and the cache of compiled kernels."""

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
    """Return a digest of the sources that kernels in ``folder`` may be compiled from: that folder and this package."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for path in sorted({*folder.glob("*.py"), *package.rglob("*.py")}):
        name = path.relative_to(package) if path.is_relative_to(package) else path.name
        digest.update(str(name).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


class _BesideTheSource(InTreeCacheLocator):
    """The folder beside the sources, even if it is not writable: the last resort."""

    def ensure_cache_path(self) -> None:
        """Accept the folder as it is."""


class _Locating(CompileResultCacheImpl):
    _locator_classes = [*CompileResultCacheImpl._locator_classes, _BesideTheSource]  # noqa: RUF012 - as numba declares it


class _IndexFile(IndexDataCacheFile):
    """An index of compiled kernels, empty if it can't be read: its signatures may name types that are no more."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index()  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001 - whatever unpickling raises; compiling again is always right
            return {}


class _KernelFiles(_IndexFile):
    """Compiled kernels of one function: first those beside the source, then those in the writable cache folder.

    A container image ships kernels beside the sources, where its user cannot write. On a CPU other than the one they
    were compiled for, new kernels are compiled and kept in NUMBA_CACHE_DIR if it is set, else only in the process.
    """

    def __init__(self, folder: str, beside: str, name: str, stamp: str) -> None:
        super().__init__(cache_path=folder, filename_base=name, source_stamp=stamp)  # type: ignore[no-untyped-call]
        self._shipped = _IndexFile(cache_path=beside, filename_base=name, source_stamp=stamp)  # type: ignore[no-untyped-call]

    def load(self, key: object) -> Any:
        """Return the kernel's data, or None."""
        return self._shipped.load(key) or super().load(key)  # type: ignore[no-untyped-call]

    def save(self, key: object, data: object) -> None:
        """Save a kernel if the folder is writable; a failure only costs time at the next start."""
        with suppress(OSError):
            super().save(key, data)  # type: ignore[no-untyped-call]


class _PackageCache(FunctionCache):
    """Compiled kernels on disk, valid until any source changes from which they may be compiled.

    numba checks only the file of the kernel itself, but helpers from other files are compiled into the kernel: after an
    upgrade that changed only such a file, numba would go on using the old kernel.
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
    if hasattr(compiled, "enable_caching"):  # false with NUMBA_DISABLE_JIT, which returns the plain function
        compiled._cache = _PackageCache(function)
    result: F = compiled
    return result


def kernel(function: F) -> F:
    """Compile ``function`` with numba: without the GIL, cached on disk, and with IEEE division.

    Python's check for a zero divisor would keep loops from vectorising. ``fastmath`` stays off, so that the same source
    gives the same bits on every machine.
    """
    # Explicitly: a kernel first called from an inlined helper would inherit its option.
    return _compile(function, forceinline=False)


def inline(function: F) -> F:
    """Compile a small helper that LLVM always inlines into the calling kernel."""
    return _compile(function, inline="never", forceinline=True)
