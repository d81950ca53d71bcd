"""How the kernels call a lens: by the address of its compiled functions, whatever lens it is.

A chunk of rays costs one indirect call. numba's own functions as arguments would do the same, but cost 17 us each time
that one is handed over from Python; a number costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ceres_cal.kernels.arguments import Optics
from ceres_cal.kernels.jit import borrowing, compile_callback, jit

_Numbers, _Rows, _Jacobian = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
SIGNATURES = (
    types.void(_Numbers, types.float64, _Numbers),
    types.boolean(types.int64, _Numbers, types.float64, _Numbers, _Rows, _Rows, _Rows),
    types.void(types.int64, _Numbers, types.float64, _Numbers, _Rows, _Rows, _Jacobian),
)
"""Of a lens's own functions: prepare, distort, differentiate."""


_CODE: Any = cgutils.__dict__["ir"]  # llvmlite, which has no stubs


@cache
def compiled_functions(
    prepare: Callable[..., None], distort: Callable[..., bool], differentiate: Callable[..., None]
) -> tuple[Any, Any, Any]:
    """A lens's own functions compiled."""
    first, second, third = map(compile_callback, (prepare, distort, differentiate), SIGNATURES)
    return first, second, third


def _calls(expected: Any) -> Any:
    """call(address, arguments) of a compiled function of that signature."""

    @intrinsic
    def call(context: Any, address: Any, arguments: Any) -> Any:
        if tuple(arguments) != expected.args:
            raise TypeError(f"a lens's function takes {expected.args}, not {tuple(arguments)}")

        def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            of_arguments = [target.get_value_type(one) for one in expected.args]
            function = _CODE.FunctionType(target.get_value_type(expected.return_type), of_arguments)
            pointer = builder.inttoptr(values[0], function.as_pointer())
            return builder.call(pointer, [builder.extract_value(values[1], k) for k in range(len(of_arguments))])

        return expected.return_type(address, arguments), generate

    return call


_call_prepare, _call_distort, _call_differentiate = map(_calls, SIGNATURES)


@jit
def prepared(optics: Optics, intrinsics: Any) -> Optics:
    """The optics with these intrinsics and what the lens derives from them."""
    state = optics.state.copy()
    _call_prepare(optics.prepare, (intrinsics[:-1], optics.unit, state))
    return Optics(
        optics.prepare, optics.distort, optics.differentiate, intrinsics, optics.unit, state, optics.work_rows
    )


@borrowing
def distort(n: int, optics: Optics, rays: Any, image: Any, work: Any) -> bool:
    """Fill `image` and `work`; False where any ray has no answer. A skew of the pixels leans the lens's own image."""
    of_lens, skew = optics.intrinsics[:-1], optics.intrinsics[-1]
    for i in range(n):
        image[7, i] = 0.0
    good = _call_distort(optics.distort, (n, of_lens, optics.unit, optics.state, rays, image, work))
    if skew != 0.0:
        for i in range(n):
            yx = image[3, i] + image[7, i]
            image[0, i] += skew * image[1, i]
            image[2, i] += skew * yx
            image[3, i] += skew * image[4, i]
            image[5, i] += skew * image[6, i]
            image[7, i] = yx - image[3, i]
    return good


@borrowing
def intrinsics_rows(n: int, optics: Optics, image: Any, work: Any, jacobian: Any) -> None:
    """Derivatives of the distorted chunk's pixels with respect to phi, aspect, principal point, coefficients, skew."""
    phi, aspect, of_lens = optics.intrinsics[0], optics.intrinsics[1], optics.intrinsics[:-1]
    count, skew = len(of_lens), optics.intrinsics[-1]
    for i in range(n):
        jacobian[0, 0, i], jacobian[0, 1, i] = (image[0, i] - skew * image[1, i]) / phi, aspect * image[1, i] / phi
        jacobian[1, 0, i], jacobian[1, 1, i] = 0.0, image[1, i]
        jacobian[2, 0, i], jacobian[2, 1, i] = 1.0, 0.0
        jacobian[3, 0, i], jacobian[3, 1, i] = 0.0, 1.0
        jacobian[count, 0, i], jacobian[count, 1, i] = image[1, i], 0.0
    _call_differentiate(optics.differentiate, (n, of_lens, optics.unit, optics.state, image, work, jacobian))
    if skew != 0.0:
        for k in range(count):
            if not 1 <= k <= 3:
                add_multiple(n, skew / aspect, jacobian[k, 1], jacobian[k, 0])


@borrowing
def add_multiple(n: int, factor: float, row: Any, own: Any) -> None:
    """own += factor times row: of two rows by themselves the compiler sees that they are not each other's."""
    for i in range(n):
        own[i] += factor * row[i]
