"""Makes the shared library of the kernels, once, where the package is built: scripts/carry_kernels.py.

Each kernel gets an entry that is called with the addresses of NumPy's arrays: it looks whether they are what the kernel
takes, reads where their numbers lie, and calls it. numba compiles that as it compiles everything else; its machine code
is linked with numba's own runtime, from which the kernels take their working arrays, so that nothing of Python is left.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import cache, reduce
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic
from numba.np import arrayobj

from ceres_cal.kernels.jit import OPTIONS, with_callees
from ceres_cal.kernels.lenses import SIGNATURES
from ceres_cal.kernels.library import FIELDS, NO, OTHER_ARRAYS, Kernel, symbol

_NJIT: Any = njit
_LLVM: Any = llvm
_CONFIG: Any = numba.config
_ARRAYS: Any = arrayobj
_CODE: Any = cgutils.__dict__["ir"]  # llvmlite, which has no stubs
_RUNTIME = Path(numba.__file__).parent / "core" / "runtime"
_KINDS = {"d": types.float64, "l": types.int64, "i": types.int32, "?": types.boolean}

# What lies where in Python's objects, in NumPy's arrays and in their descriptions (its C interface's own promise).
_TYPE = 8
_DATA, _NDIM, _SHAPE, _STRIDES, _DESCRIPTION, _FLAGS = 16, 24, 32, 40, 56, 64
_LETTER, _ORDER = 25, 26
_C_ORDER, _ALIGNED, _WRITEABLE = 0x1, 0x100, 0x400

_READY = """extern "C" void NRT_MemSys_init();
extern "C" int ready() {{ if (!({})) return 0; NRT_MemSys_init(); return 1; }}
extern "C" const char *numba_version() {{ return "{}"; }}
"""


def compiler() -> str | None:
    """The C++ compiler that links; None where there is none."""
    return shutil.which("c++") or shutil.which("g++")


def link(path: Path, kernels: list[Kernel], lenses: list[tuple[Callable[..., Any], ...]]) -> Iterator[None]:
    """Make the library of some kernels and of lenses' own functions; a step for each of them.

    numba has to be set to the processor that it is for (NUMBA_CPU_NAME, NUMBA_CPU_FEATURES).

    Raises:
        subprocess.CalledProcessError: the C++ compiler says no.
    """
    names: list[str] = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        for kernel in kernels:
            entry = _entry(kernel)
            _emit(entry.library, entry.fndesc.llvm_func_name, kernel.name, folder)
            names.append(kernel.name)
            yield
        for functions in lenses:
            for function, signature in zip(functions, SIGNATURES, strict=True):
                _emit(_by_address(function, signature), symbol(function), symbol(function), folder)
                names.append(symbol(function))
            yield
        _link(path, names, folder)


def _emit(library: Any, name: str, exported: str, folder: Path) -> None:
    """Machine code of one function and of what it calls, that may lie anywhere."""
    module = _LLVM.parse_bitcode(library._final_module.as_bitcode())
    for function in module.functions:
        if not function.is_declaration and function.name != name:
            function.linkage = "internal"
    module.get_function(name).name = exported
    machine = _LLVM.Target.from_default_triple().create_target_machine(
        cpu=_CONFIG.CPU_NAME, features=_CONFIG.CPU_FEATURES, opt=3, reloc="pic", codemodel="default"
    )
    unused = _LLVM.create_new_module_pass_manager()
    unused.add_global_dead_code_eliminate_pass()
    unused.run(module, _LLVM.create_pass_builder(machine, _LLVM.create_pipeline_tuning_options()))
    (folder / f"{exported}.o").write_bytes(machine.emit_object(module))


def _link(path: Path, names: list[str], folder: Path) -> None:
    features = [one.strip("+") for one in _CONFIG.CPU_FEATURES.split(",")]
    looks = " && ".join(f'__builtin_cpu_supports("{feature}")' for feature in features)
    exported = " ".join(f'"{name}";' for name in (*names, "ready", "numba_version"))
    (folder / "names").write_text(f"{{ global: {exported} local: *; }};\n")
    (folder / "ready.cpp").write_text(_READY.format(looks, numba.__version__))
    made = path.with_suffix(f".{uuid4().hex[:16]}")
    path.parent.mkdir(parents=True, exist_ok=True)
    run = [compiler() or "c++", "-O2", "-fPIC", "-fno-exceptions", "-fno-rtti", "-shared", "-s", "-o", str(made)]
    run += [*map(str, sorted(folder.glob("*.o"))), str(folder / "ready.cpp"), str(_RUNTIME / "nrt.cpp")]
    run += [f"-I{_RUNTIME}", f"-I{_RUNTIME.parents[1]}", "-static-libgcc", "-Wl,--gc-sections", "-Wl,--as-needed"]
    subprocess.run([*run, f"-Wl,--version-script={folder / 'names'}"], check=True)
    made.replace(path)


# ---- entries --------------------------------------------------------------------------------------------------------


def _entry(kernel: Kernel) -> Any:
    """Compiled: the type of NumPy's arrays, then what the kernel takes one by one, arrays as their addresses."""
    known: dict[str, Any] = {"kernel": kernel.compiled, "is_array": _is_array} | {
        fields.__name__: fields for fields in FIELDS
    }
    flat, looks = kernel.flat, []
    for number, one in enumerate(flat):
        if one[1:]:
            known[f"fits_{number}"], known[f"array_{number}"] = _fits(one), _array(one)
            looks.append(f"is_array(array, x{number}) and fits_{number}(x{number})")
    numbers = iter(enumerate(flat))

    def written(taken: type | str) -> str:
        if isinstance(taken, str):
            number, _ = next(numbers)
            return f"array_{number}(x{number})" if taken[1:] else f"x{number} != 0" if taken == "?" else f"x{number}"
        return f"{taken.__name__}({', '.join(written(one) for one in FIELDS[taken].split())})"

    source = (
        f"def entry(array, {', '.join(f'x{number}' for number in range(len(flat)))}):\n"
        f"    if not ({' and '.join(looks)}):\n        return {OTHER_ARRAYS}\n"
        f"    return {NO} if kernel({', '.join(written(taken) for taken in kernel.takes)}) == False else 1\n"
    )
    exec(source, known)
    kinds = (types.int64, *(types.float64 if one == "d" else types.int64 for one in flat))
    entry = _NJIT(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **OPTIONS)(known["entry"])
    entry.compile(kinds)
    return entry.overloads[kinds]


def _by_address(function: Callable[..., Any], signature: Any) -> Any:
    """A lens's function for calls by address, as `compile_callback` makes it but for what it raises: an answer of 0."""
    compiled = _NJIT(_nrt=False, **OPTIONS)(with_callees(function, set()))
    compiled.compile(signature.args)
    native = compiled.overloads[signature.args]
    target, described = native.target_context, native.fndesc
    module = target.create_module(symbol(function))
    calls = target.call_conv.get_function_type(described.restype, described.argtypes)
    callee = _CODE.Function(module, calls, described.llvm_func_name)
    takes = [target.get_value_type(one) for one in described.argtypes]
    whole = _CODE.Function(
        module, _CODE.FunctionType(target.get_value_type(described.restype), takes), symbol(function)
    )
    builder = _CODE.IRBuilder(whole.append_basic_block())
    status, answer = target.call_conv.call_function(builder, callee, described.restype, described.argtypes, whole.args)
    builder.ret(builder.select(status.is_ok, answer, _CODE.Constant(answer.type, None)))
    library = target.codegen().create_library(symbol(function))
    library.add_linking_library(native.library)
    library.add_ir_module(module)
    with global_compiler_lock:
        library.finalize()
    return library


def _load(builder: Any, address: Any, offset: int, kind: Any) -> Any:
    place = builder.add(address, _CODE.Constant(address.type, offset))
    return builder.load(builder.inttoptr(place, kind.as_pointer()))


@intrinsic
def _is_array(context: Any, array: Any, address: Any) -> Any:
    """Whether what lies at an address is of this type: else nothing more of it may be read."""

    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.icmp_unsigned("==", _load(builder, values[1], _TYPE, values[0].type), values[0])

    return types.boolean(array, address), generate


@cache
def _fits(wanted: str) -> Any:
    """Whether the array at an address is such as is wanted, its numbers one after another."""
    long, word, byte = _CODE.IntType(64), _CODE.IntType(32), _CODE.IntType(8)
    flags = _C_ORDER | _ALIGNED | (_WRITEABLE if wanted.endswith("*") else 0)

    @intrinsic
    def fits(context: Any, address: Any) -> Any:
        def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            (at,) = values
            description = _load(builder, at, _DESCRIPTION, long)
            held = builder.and_(_load(builder, at, _FLAGS, word), _CODE.Constant(word, flags))
            looks = (
                (_load(builder, at, _NDIM, word), int(wanted[1])),
                (_load(builder, description, _LETTER, byte), ord(wanted[0])),
                (_load(builder, description, _ORDER, byte), ord(np.dtype(wanted[0]).byteorder)),
                (held, flags),
            )
            equal = [builder.icmp_unsigned("==", value, _CODE.Constant(value.type, wants)) for value, wants in looks]
            return reduce(builder.and_, equal)

        return types.boolean(address), generate

    return fits


@cache
def _array(wanted: str) -> Any:
    """The array at an address, which its caller holds."""
    kind = types.Array(_KINDS[wanted[0]], int(wanted[1]), "C")
    long = _CODE.IntType(64)

    @intrinsic
    def array(context: Any, address: Any) -> Any:
        def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            made = target.make_array(kind)(target, builder)
            shape, strides = (_load(builder, values[0], place, long) for place in (_SHAPE, _STRIDES))
            size = target.get_abi_sizeof(target.get_data_type(kind.dtype))
            _ARRAYS.populate_array(
                made,
                data=builder.inttoptr(_load(builder, values[0], _DATA, long), made.data.type),
                shape=[_load(builder, shape, 8 * axis, long) for axis in range(kind.ndim)],
                strides=[_load(builder, strides, 8 * axis, long) for axis in range(kind.ndim)],
                itemsize=target.get_constant(types.intp, size),
                meminfo=None,
            )
            return made._getvalue()

        return kind(address), generate

    return array
