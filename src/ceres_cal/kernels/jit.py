"""How the kernels are compiled."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

from numba import njit
from numba.core.ccallback import CFunc

from ceres_cal.kernels.sources import digest
from ceres_cal.kernels.store import KernelStore

_NJIT: Any = njit  # no stub knows `_nrt`: whether references are counted

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"reassoc", "contract", "nsz"}}


def jit(function: Callable[..., Any], counted: bool = True) -> Callable[..., Any]:
    """Compile without the GIL; reassoc and contract let sums be vectorised, NaN and infinity keep their meaning."""
    compiled: Callable[..., Any] = _kept(_NJIT(nogil=True, _nrt=counted, **OPTIONS)(function), function, set())
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
    whole = with_callees(function, files)
    taken = signature.args, signature.return_type
    callback: Any = CFunc(whole, taken, locals={}, options={"_nrt": False, **OPTIONS})
    _kept(callback, whole, files).compile()
    return callback


def _kept(compiled: Any, function: Callable[..., Any], files: set[Path]) -> Any:
    """The same, which is not compiled yet, with what it becomes kept in files; it comes from `files` and its own."""
    files = {*files, Path(inspect.getfile(function))}
    if all(path.is_file() for path in files):  # what was typed into an interpreter is compiled each time
        compiled._cache = KernelStore(function, digest(files))
    return compiled


def with_callees(function: Any, files: set[Path]) -> FunctionType:
    """The function with compiled ones in place of the plain functions that it names; `files` are where they all are."""
    files.add(Path(inspect.getfile(function)))
    known = function.__globals__
    plain = {name: known[name] for name in function.__code__.co_names if isinstance(known.get(name), FunctionType)}
    compiled = {name: _NJIT(_nrt=False, **OPTIONS)(with_callees(one, files)) for name, one in plain.items()}
    whole = FunctionType(function.__code__, {**known, **compiled}, function.__name__, None, function.__closure__)
    whole.__qualname__ = function.__qualname__
    return whole
