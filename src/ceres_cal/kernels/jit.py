"""How the kernels are compiled and where the machine code is kept.

numba's cache looks at the file of the compiled function alone, not at the files it calls into. So the kernels are kept
in a folder named after all their sources: change one line of one of them and all are compiled anew.
"""

from __future__ import annotations

import fcntl
import hashlib
import inspect
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FunctionType
from typing import Any

from numba import cfunc, config, njit
from numba.core.caching import FunctionCache

_CONFIG: Any = config  # numba makes its settings at import; no stub knows them
_NJIT: Any = njit  # nor `_nrt`: whether references are counted
_CFUNC: Any = cfunc


def _cache_folder() -> Path:
    base = _CONFIG.CACHE_DIR or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ceres-cal" / _digest(Path(__file__).parent.glob("*.py"))


def _digest(paths: Iterable[Path]) -> str:
    sources = hashlib.sha256()
    for path in sorted(paths):
        sources.update(path.read_bytes())
    return sources.hexdigest()[:16]


CACHE_FOLDER = _cache_folder()


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


_CACHED = _is_writable(CACHE_FOLDER)


_LONGEST_S = 600
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"reassoc", "contract", "nsz"}}


class _SharedCache(FunctionCache):
    """numba's cache for several processes: one compiles, the others wait and take what it made.

    Without the lock each would compile everything, and one's machine code could end up under another's signature.
    """

    _handle: int | None = None  # of the locked file, which all functions share: one's compilation calls for others'
    _depth = 0

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """See numba; None, with the lock taken, where it must be compiled."""
        loaded = self._loaded(sig, target_context)
        if loaded is None:
            self.lock()
            loaded = self._loaded(sig, target_context)  # somebody else may have compiled it meanwhile
            if loaded is not None:
                self.unlock()
        return loaded

    def save_overload(self, sig: Any, data: Any) -> None:
        """See numba; what cannot be kept, on a full disk for one, is used all the same."""
        try:
            with suppress(OSError):
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        finally:
            self.unlock()

    def _loaded(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # a damaged file unpickles to anything
            return None

    @staticmethod
    def lock() -> None:
        """Wait until no other process compiles."""
        if _SharedCache._depth == 0:
            with suppress(OSError):
                _SharedCache._handle = os.open(CACHE_FOLDER / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
                _wait_for(_SharedCache._handle)
        _SharedCache._depth += 1

    @staticmethod
    def unlock() -> None:
        """Let other processes compile; not before the first of those that took the lock in this one is done."""
        _SharedCache._depth -= 1
        if _SharedCache._depth == 0 and _SharedCache._handle is not None:
            os.close(_SharedCache._handle)
            _SharedCache._handle = None


def _wait_for(handle: int) -> None:
    """Lock a file; after some minutes, longer than all kernels take, go on without."""
    for _ in range(10 * _LONGEST_S):
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.1)
        else:
            return


def _shared(compiled: Any, function: Callable[..., Any]) -> Any:
    """The same, which is not compiled yet, kept in the cache that processes share."""
    if _CACHED:
        compiled._cache = _SharedCache(function)  # type: ignore[no-untyped-call]
    return compiled


@contextmanager
def _cached_in(folder: Path) -> Iterator[None]:
    others = _CONFIG.CACHE_DIR
    _CONFIG.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        _CONFIG.CACHE_DIR = others


def jit(function: Callable[..., Any], counted: bool = True) -> Callable[..., Any]:
    """Compile without the GIL; reassoc and contract let sums be vectorised, NaN and infinity keep their meaning."""
    with _cached_in(CACHE_FOLDER):
        compiled: Callable[..., Any] = _shared(_NJIT(nogil=True, _nrt=counted, **_OPTIONS)(function), function)
    return compiled


def borrowing(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same of what makes no array: its callers keep all of them, and to count references to every array of every
    tuple would take a tenth of the time.
    """
    return jit(function, counted=False)


def compile_callback(function: Callable[..., Any], signature: Any) -> Any:
    """A plain function, and the plain functions that it calls, compiled for calls by address; kept like the kernels.

    Its arrays are its callers': it makes none.
    """
    files: set[Path] = set()
    whole = _with_callees(function, files)
    readable = all(path.is_file() for path in files)  # what was typed into an interpreter is compiled each time
    _SharedCache.lock()
    try:
        with _cached_in(CACHE_FOLDER / _digest(files) if readable else CACHE_FOLDER):
            return _CFUNC(signature, cache=_CACHED and readable, _nrt=False, **_OPTIONS)(whole)
    finally:
        _SharedCache.unlock()


def _with_callees(function: Any, files: set[Path]) -> FunctionType:
    """The function with compiled ones in place of the plain functions that it names; `files` are where they all are."""
    files.add(Path(inspect.getfile(function)))
    known = function.__globals__
    plain = {name: known[name] for name in function.__code__.co_names if isinstance(known.get(name), FunctionType)}
    compiled = {name: _NJIT(_nrt=False, **_OPTIONS)(_with_callees(one, files)) for name, one in plain.items()}
    whole = FunctionType(function.__code__, {**known, **compiled}, function.__name__, None, function.__closure__)
    whole.__qualname__ = function.__qualname__
    return whole
