"""Where the machine code of kernels that are compiled here is kept, and how it comes back.

numba's own cache looks at the file of the compiled function alone, not at the files it calls into, and it sets all of
the compiler up before it reads anything. Here a kernel's file is named after everything that its code depends on, all
the kernels' sources among it; and nothing of the compiler is loaded before there is something to compile.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import pickle
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any
from uuid import uuid4

import llvmlite.binding as llvm
import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CR_FIELDS, CompileResult
from numba.core.environment import Environment, _rebuild_env, lookup_environment
from numba.core.runtime import nrt
from numba.core.serialize import dumps

from ceres_cal.kernels.sources import digest

_HERE = Path(__file__).parent
_LONGEST_S = 600
_LIBRARY: Any = JITCodeLibrary  # no stub knows what it inherits
_LLVM: Any = llvm
_CONFIG: Any = numba.config  # numba makes its settings at import


def _release() -> str:
    """Names everything that all kernels depend on, but the processor."""
    return f"{digest(_HERE.glob('*.py'))}-{sys.implementation.cache_tag}-numba{numba.__version__}"


_RELEASE = _release()


def _cache_folder() -> Path:
    base = _CONFIG.CACHE_DIR or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ceres-cal" / _RELEASE


CACHE_FOLDER = _cache_folder()


@cache
def _own_folder(codegen: Any) -> Path:
    """Of what was compiled here, for this processor."""
    processor = codegen.magic_tuple()
    return CACHE_FOLDER / f"{processor[1]}-{hashlib.sha256(repr(processor).encode()).hexdigest()[:8]}"


class KernelStore:
    """One function's machine code by signature, for several processes: one compiles, the others wait and take it.

    What numba asks of a function's cache, and no more.
    """

    _handle: int | None = None  # of the locked file, which all functions share: one's compilation calls for others'
    _depth = 0

    def __init__(self, function: Callable[..., Any], sources: str) -> None:
        """`sources`: digest of the files of the function and of what it calls beside the kernels."""
        code = function.__code__
        closure = [cell.cell_contents for cell in function.__closure__ or ()]
        self._name = function.__qualname__
        kept = dumps(closure) if closure else b""  # type: ignore[no-untyped-call]
        self._key = (function.__module__, code.co_firstlineno, code.co_code, kept, sources)
        self.cache_path = str(CACHE_FOLDER)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The compiled function; None, with the lock taken, where it must be compiled."""
        name, own = self._file_name(signature), _own_folder(target.codegen())
        loaded = _loaded(own / name, target)
        if loaded is None:
            self.lock()
            loaded = _loaded(own / name, target)
            if loaded is not None:  # somebody else compiled it meanwhile
                self.unlock()
            else:
                _say_that_it_takes_time()
        return loaded

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a compiled function; what cannot be kept, in a home that is read-only for one, is used all the same."""
        try:
            with suppress(OSError):
                _save(compiled, _own_folder(compiled.codegen) / self._file_name(signature))
        finally:
            self.unlock()

    def _file_name(self, signature: Any) -> str:
        key = hashlib.sha256(repr((self._key, str(signature))).encode()).hexdigest()
        return f"{self._name}-{key[:24]}.nbc"

    @staticmethod
    def lock() -> None:
        """Wait until no other process compiles."""
        if KernelStore._depth == 0:
            with suppress(OSError):
                CACHE_FOLDER.mkdir(parents=True, exist_ok=True)
                KernelStore._handle = os.open(CACHE_FOLDER / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
                _wait_for(KernelStore._handle)
        KernelStore._depth += 1

    @staticmethod
    def unlock() -> None:
        """Let other processes compile; not before the first of those that took the lock in this one is done."""
        KernelStore._depth -= 1
        if KernelStore._depth == 0 and KernelStore._handle is not None:
            os.close(KernelStore._handle)
            KernelStore._handle = None


def _wait_for(handle: int) -> None:
    """Lock a file; after some minutes, longer than all kernels take, go on without."""
    for _ in range(10 * _LONGEST_S):
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.1)
        else:
            return


@cache
def _say_that_it_takes_time() -> None:
    """One line on standard error in a process that compiles, unless the caller has logging do otherwise."""
    import logging

    some = next(CACHE_FOLDER.rglob("*.nbc"), None)
    how_long = "some seconds each" if some else "one or two minutes in all"
    logging.getLogger("ceres_cal").warning("ceres-cal: compiling kernels for this machine, once: %s", how_long)


# ---- files ----------------------------------------------------------------------------------------------------------


class _KeptLibrary(_LIBRARY):  # type: ignore[misc]
    """Machine code from a file. Its bitcode is read when another function that calls it is compiled, if ever."""

    def __init__(self, codegen: Any, name: str, machine_code: bytes, bitcode: bytes, symbols: frozenset[str]) -> None:
        super().__init__(codegen, name)
        self._shared_module: Any = None
        self._bitcode = bitcode
        self.enable_object_caching()
        self._set_compiled_object(machine_code)
        self._finalize_final_module()
        codegen._engine._defined_symbols |= symbols

    def _get_module_for_linking(self) -> Any:
        self._shared_module = self._shared_module or _LLVM.parse_bitcode(self._bitcode)
        return self._shared_module


def _save(compiled: Any, path: Path) -> None:
    (name, _, code), *others = compiled._reduce()
    module = compiled.library._get_module_for_linking()
    things = [*module.functions, *module.global_variables]
    symbols = frozenset(one.name for one in things if not one.is_declaration)
    temporary = path.with_suffix(f".{uuid4().hex[:16]}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        temporary.write_bytes(dumps(((name, *code, symbols), *others)))  # type: ignore[no-untyped-call]
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _loaded(path: Path, target: Any) -> Any:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    try:
        return _rebuilt(_Reader(BytesIO(content)).load(), target)
    except Exception:  # a damaged file unpickles to anything
        return None


class _Reader(pickle.Unpickler):
    """Environments without the modules that they come from: compiled code takes nothing but constants from them, and
    half of numba would be imported for it.
    """

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == (_rebuild_env.__module__, _rebuild_env.__name__):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: Any, name: str) -> Any:
    environment: Any = lookup_environment(name)  # type: ignore[no-untyped-call]
    if environment is None:
        environment = Environment({"__name__": module})
        environment.consts[:] = constants
        environment.env_name = name
        Environment._memo[name] = environment
    return environment


def _rebuilt(content: Any, target: Any) -> Any:
    """What `CompileResult._rebuild` makes, without setting up the compiler."""
    code, described, environment, signature, object_mode, lifted, annotation, initialisers, environments = content
    nrt.rtsys.initialize(target)
    for initialise in initialisers:
        initialise()
    library = _KeptLibrary(target.codegen(), *code)
    fields = dict.fromkeys(CR_FIELDS) | {
        "typing_context": target.typing_context,
        "target_context": target,
        "entry_point": target.get_executable(library, described, environment),
        "type_annotation": annotation,
        "signature": signature,
        "objectmode": object_mode,
        "lifted": lifted,
        "fndesc": described,
        "library": library,
        "environment": environment,
        "reload_init": initialisers,
        "referenced_envs": environments,
    }
    for one in environments:
        library.codegen.set_env(one.env_name, one)
    return CompileResult(**fields)
