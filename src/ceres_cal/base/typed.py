"""Type checks of arguments given from Python: the annotated types, or an error of one line that names the argument."""

from __future__ import annotations

import inspect
import numbers
import os
from collections.abc import Callable, Mapping
from functools import cache, wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert
from ceres_cal.base.words import did_you_mean

P = ParamSpec("P")
R = TypeVar("R")
_MOST_LETTERS = 40  # letters shown of a wrong value
_UNIONS: tuple[Any, ...] = (Union, UnionType)
_PLAIN, _OF_NUMPY = frozenset((str, bool, int, float, NoneType)), (np.ndarray, np.generic)
_ALIKE: Mapping[Any, tuple[type, ...]] = {
    float: (numbers.Real,),
    int: (numbers.Integral,),
    bool: (bool, np.bool_),
    Path: (str, os.PathLike),
    str: (str,),
}
"""Types accepted for an annotated type; for every other class its own instances."""


def take_types(instance: Any) -> None:
    """Convert the values of a new dataclass to plain Python values of the annotated types; lists are accepted for
    tuples, and NumPy's numbers as well.

    Raises:
        InputError: a value has another type; the message names the field.
    """
    of, held = type(instance), vars(instance)
    for name, kind, default in _fields(of):  # type: ignore[arg-type] # a class has a hash
        value = held.get(name, default)  # a default that is not stored is an attribute of the class
        if type(value) is not kind and value is not default:
            held[name] = convert(_plain(value), kind, f"{of.__name__}({name}=...)")


@cache
def _fields(of: type) -> list[tuple[str, Any, Any]]:
    """Return name, type and default of each field."""
    return [(name, kind, getattr(of, name, _fields)) for name, kind in get_type_hints(of).items()]


def _plain(value: Any) -> Any:
    """Convert NumPy's numbers and arrays to Python's, also within lists and mappings."""
    if type(value) in _PLAIN:  # most values
        return value
    if isinstance(value, _OF_NUMPY):  # NumPy's str is a Python str, too, but no file takes it
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, Mapping):
        return {_plain(name): _plain(entry) for name, entry in value.items()}
    return value


# ---- arguments of functions -----------------------------------------------------------------------------------------


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Make a public function raise InputError, naming the argument, for a value of another type than annotated.

    Plain classes, their unions and literals are checked. Arrays are checked where they are read (`rows`).
    """
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise InputError(f"{function.__name__}(): {error}{_meant(kwargs, signature.parameters)}") from None
        for name, value in given.items():
            kinds, many = _kinds(function, name), signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD
            for own, one in value.items() if many else ((name, value),):
                if kinds and not _fits(one, kinds):
                    raise InputError(f"{function.__name__}(): {_wrong(own, one, kinds, function, given)}")
        return function(*map(_of_python, args), **{name: _of_python(value) for name, value in kwargs.items()})

    return call


def _of_python(value: Any) -> Any:
    """Return a number or text of NumPy as Python's: products of its small integers would wrap around."""
    return value.item() if isinstance(value, np.generic) else value


def _meant(given: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    unknown = [name for name in given if name not in known]
    return did_you_mean(unknown[0], known) if unknown else ""


@cache
def _every(function: Callable[..., Any], name: str) -> tuple[Any, ...]:
    """Return the alternatives of an argument's annotation."""
    kind = function.__annotations__.get(name, Any)
    if isinstance(kind, str):
        try:
            kind = eval(kind, getattr(inspect.unwrap(function), "__globals__", {}))
        except NameError:  # quiet: imported for type checkers alone: the function itself reads the value
            return ()
    every = get_args(kind) if get_origin(kind) in _UNIONS else (kind,)
    return tuple(Mapping if get_origin(one) is Mapping else one for one in every)


def _is_plain(kind: Any) -> bool:
    return (isinstance(kind, type) and kind is not Any) or get_origin(kind) is Literal


def _kinds(function: Callable[..., Any], name: str) -> tuple[Any, ...]:
    """Return the types that an argument may have; empty if it cannot be checked by its type."""
    every = _every(function, name)
    return every if all(map(_is_plain, every)) else ()


def _fits(value: Any, kinds: tuple[Any, ...]) -> bool:
    return any(
        value in get_args(one) if get_origin(one) is Literal else isinstance(value, _ALIKE.get(one, one))
        for one in kinds
    )


def _wrong(name: str, value: Any, kinds: tuple[Any, ...], function: Callable[..., Any], given: dict[str, Any]) -> str:
    """Return what is wrong with an argument, and what to give."""
    expected = [one for one in kinds if one is not NoneType]
    words = " or ".join(
        " or ".join(map(repr, get_args(one))) if get_origin(one) is Literal else _named(one) for one in expected
    )
    shown = f"{type(value).__name__} {value!r:.{_MOST_LETTERS}}" if isinstance(value, str | int | float) else ""
    said = f"{name} must be {words}, not {shown or _named(type(value))}"
    for other, its in given.items():
        fitting = tuple(filter(_is_plain, _every(function, other)))
        if other != name and _fits(value, fitting) and _fits(its, kinds):
            return f"{said}: exchange {name} and {other}"
    loading = [one for one in expected if hasattr(one, "load")]
    if loading and isinstance(value, str | os.PathLike):
        return f"{said}: read the file with {loading[0].__name__}.load"
    return said


def _named(kind: type) -> str:
    word = {str: "text", Path: "path", int: "whole number", float: "number"}.get(kind, kind.__name__)
    return f"{'an' if word[0] in 'AEIOUaeio' else 'a'} {word}"


# ---- arrays ---------------------------------------------------------------------------------------------------------


def numbers_in(values: Any, name: str) -> Array:
    """Return an array of real numbers, NaN where masked; InputError naming the argument for anything else."""
    try:
        if np.iscomplexobj(values):
            raise TypeError("complex")
        given, mask = np.asarray(values, dtype=float), getattr(values, "mask", None)  # without importing `numpy.ma`
        return np.where(mask, np.nan, given) if isinstance(mask, np.ndarray) else given
    except (TypeError, ValueError):
        raise InputError(f"{name} must be numbers, not {type(values).__name__} {values!r:.{_MOST_LETTERS}}") from None


def size_in(values: Any, name: str = "image_size") -> tuple[int, int]:
    """Return width and height of an image; InputError naming the argument for anything else."""
    given = numbers_in(values, name)
    if given.shape != (2,) or not all(side >= 1.0 and side.is_integer() for side in given.tolist()):
        raise InputError(f"{name} must be (width, height) in px, two positive whole numbers, not {values!r}")
    return int(given[0]), int(given[1])


def rows(values: Any, columns: int, name: str) -> Array:
    """Return an array (N, columns) of numbers; InputError naming the argument for anything else."""
    given = numbers_in(values, name)
    if given.ndim != 2 or given.shape[1] != columns:
        raise InputError(f"{name} must have shape (N, {columns}), not {given.shape}")
    return given
