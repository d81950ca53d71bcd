"""The kernels as everybody calls them: from the shared library that came with the package, else compiled here.

The library (see linking.py) is loaded in a few milliseconds and without numba, whose import alone takes longer than
most solves. It reads NumPy's arrays where they are; arrays that are not laid out as a kernel wants them go to numba,
which compiles for them.
"""

from __future__ import annotations

import ctypes
import platform
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ceres_cal.base.cached import cached_property
from ceres_cal.kernels.arguments import Blocks, CurveColumns, Loss, Optics, PointColumns, Sweep, Unknowns
from ceres_cal.kernels.sources import digest

_HERE = Path(__file__).parent
RAISED, OTHER_ARRAYS, NO = range(-2, 1)
"""What a kernel of the library answers beside yes: `OTHER_ARRAYS` before it has done anything."""

# What the library is compiled for, by machine: ten years of processors have these features.
BASELINES = {"x86_64": ("x86-64-v3", ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"))}

FIELDS = {
    Optics: "l l l d1 d d1 l",
    PointColumns: "l1 d2 d2 d1 i2 d2",
    CurveColumns: "l1 d3 ?1 i1 d2 d1 d1* i2",
    Loss: "l d",
    Unknowns: "l1 l",
    Blocks: "d1* d1* d1* d1*",
    Sweep: "d3* d3* d1* d2*",
}
"""NumPy's letter of each number's kind, of arrays with their dimensions, and a star where the kernel writes."""


@cache
def library_path() -> Path:
    """Where the library of these sources lies: scripts/carry_kernels.py."""
    sources = digest([*_HERE.glob("*.py"), *_HERE.parent.glob("scene/lens/*.py")])
    baseline = BASELINES.get(platform.machine(), ("none",))[0]
    python = f"{sys.implementation.cache_tag}{sys.abiflags}"  # how its objects lie in memory
    return _HERE / "carried" / f"{sources}-{python}-{baseline}.so"


@cache
def _library() -> ctypes.CDLL | None:
    """None where there is none of these sources, or none that runs here."""
    try:
        library = ctypes.CDLL(str(library_path()))
    except OSError:
        return None
    return library if library.ready() else None


def numba_version() -> str:
    """Of the numba that compiles, or has compiled, what is called."""
    library = _library()
    if library is None:
        return str(import_module("numba").__version__)
    library.numba_version.restype = ctypes.c_char_p
    return str(library.numba_version().decode())


class Kernel:
    """One kernel, to be called; its answer is True, but for what ends with False."""

    def __init__(self, name: str, *takes: type | str) -> None:
        """`name`: module and function. `takes`: its arguments, as `FIELDS` has them."""
        self.module, self.name = name.split(".")
        self.takes = takes

    @property
    def flat(self) -> list[str]:
        """What it takes with the tuples' fields one by one."""
        return [one for taken in self.takes for one in ([taken] if isinstance(taken, str) else FIELDS[taken].split())]

    @property
    def compiled(self) -> Callable[..., Any]:
        """By numba."""
        return getattr(import_module(f"ceres_cal.kernels.{self.module}"), self.name)

    @cached_property
    def _carried(self) -> Any:
        library = _library()
        if library is None:
            return None
        function = library[self.name]
        scalars: dict[str, Any] = {"l": ctypes.c_int64, "?": ctypes.c_int64, "d": ctypes.c_double}
        kinds = [scalars.get(one, ctypes.py_object) for one in self.flat]
        function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.py_object, *kinds]
        return function

    def __call__(self, *arguments: Any) -> bool:
        """See the kernel itself."""
        if self._carried is None:
            return self.compiled(*arguments) is not False
        flat: list[Any] = []
        for one in arguments:
            if isinstance(one, tuple):
                flat += one
            else:
                flat.append(one)
        answer = self._answer(flat)
        if answer == OTHER_ARRAYS:  # a map of a file is an array by another name
            answer = self._answer([np.asarray(one) if isinstance(one, np.ndarray) else one for one in flat])
        if answer == OTHER_ARRAYS:
            return self.compiled(*arguments) is not False
        if answer == RAISED:
            raise MemoryError(f"{self.name}: there is no room for what it works with")
        return bool(answer != NO)

    def _answer(self, flat: list[Any]) -> int:
        answer, raised = ctypes.c_int64(), ctypes.c_void_p()
        status = self._carried(ctypes.byref(answer), ctypes.byref(raised), np.ndarray, *flat)
        return RAISED if status else answer.value


@cache
def lens_functions(
    prepare: Callable[..., None], distort: Callable[..., bool], differentiate: Callable[..., None]
) -> tuple[int, int, int]:
    """Addresses of a lens's own functions as `Optics` takes them. See `scene.lens.Lens`."""
    library, names = _library(), [symbol(one) for one in (prepare, distort, differentiate)]
    if library is not None and all(hasattr(library, name) for name in names):
        first, second, third = (ctypes.cast(library[name], ctypes.c_void_p).value for name in names)
        return first or 0, second or 0, third or 0
    from ceres_cal.kernels.lenses import compiled_functions

    prepared, distorted, differentiated = compiled_functions(prepare, distort, differentiate)
    return prepared.address, distorted.address, differentiated.address


def symbol(function: Callable[..., Any]) -> str:
    """What a lens's function is called in the library."""
    return f"{function.__module__}.{function.__qualname__}"
