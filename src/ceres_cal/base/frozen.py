"""Frozen data classes, and values that are computed or imported when they are first used: properties, names of a
package, rows of tables.
"""

from __future__ import annotations

import re
import sys
from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, FrozenInstanceError, dataclass, fields
from dataclasses import field as field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, cast, dataclass_transform

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import did_you_mean


class _Signature:
    """Signature of a class's constructor, computed when it is asked for."""

    def __get__(self, instance: Any, owner: Any) -> Any:
        from inspect import Parameter, Signature

        def told(name: str, one: Field[Any]) -> Parameter:
            kind = Parameter.KEYWORD_ONLY if one.kw_only else Parameter.POSITIONAL_OR_KEYWORD
            default = one.default if one.default_factory is MISSING else one.default_factory
            default = Parameter.empty if default is MISSING else default
            return Parameter(name, kind, default=default, annotation=one.type)

        every = sorted(owner.__dataclass_fields__.items(), key=lambda one: bool(one[1].kw_only))
        return Signature([told(*one) for one in every])


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field,))
class Frozen:
    """A dataclass whose instances do not change. Instances are equal only to themselves, since they may hold arrays, or
    by their values with `class Size(Frozen, eq=True)`.

    What `dataclass(frozen=True)` generates for each class is written here once: a class is made three times as fast,
    and hundreds are made before a command begins.
    """

    if TYPE_CHECKING:  # msgspec reads annotations
        __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    else:
        __signature__ = _Signature()

    def __init_subclass__(cls, *, eq: bool = False, kw_only: bool = False, **others: Any) -> None:
        super().__init_subclass__(**others)
        dataclass(init=False, repr=False, eq=False, kw_only=kw_only)(cls)
        cls.__dataclass_fields__ = {one.name: one for one in fields(cls)}  # without class variables
        if eq:
            cls.__eq__, cls.__hash__ = _are_equal, lambda one: hash(_held(one))  # type: ignore[assignment]

    if not TYPE_CHECKING:

        def __init__(self, *args: Any, **given: Any) -> None:
            every, by_place = _fields_of(type(self))
            if not given and len(args) == len(every) == len(by_place):  # the usual call, in a third of the time
                self.__dict__.update(zip(by_place, args, strict=True))
            else:
                self.__dict__.update(_values(type(self), args, given))
            if hasattr(self, "__post_init__"):
                self.__post_init__()

    def __setattr__(self, name: str, value: object) -> None:
        if name in self.__dict__ or name not in self.__dataclass_fields__:
            raise FrozenInstanceError(f"cannot assign to field {name!r}")
        self.__dict__[name] = value

    def __delattr__(self, name: str) -> None:
        raise FrozenInstanceError(f"cannot delete field {name!r}")

    def __repr__(self) -> str:
        from ceres_cal.base.shown import brief

        most = 300  # letters: of what is longer, a line for each part
        held = ", ".join(f"{name}={getattr(self, name)!r}" for name in self.__dataclass_fields__)
        text = f"{type(self).__qualname__}({held})"
        return text if len(text) <= most else brief(self)


def _are_equal(one: Any, other: object) -> Any:
    return _held(one) == _held(other) if type(other) is type(one) else NotImplemented


def _held(one: Any) -> tuple[Any, ...]:
    return tuple(getattr(one, name) for name in one.__dataclass_fields__)


@cache
def _fields_of(of: Any) -> tuple[list[tuple[str, Field[Any]]], list[str]]:
    """Return the fields of a class by name, and the names of those that may be positional."""
    return [(one.name, one) for one in fields(of)], [one.name for one in fields(of) if not one.kw_only]


def _values(of: type, args: tuple[Any, ...], given: dict[str, Any]) -> dict[str, Any]:
    """Return the value of each field of a class; InputError for an unknown name."""
    every, by_place = _fields_of(of)
    values, held = dict(zip(by_place, args, strict=False), **given), {}
    if len(values) < len(args) + len(given):
        raise TypeError(f"{of.__name__}() is given too many values, or one of them twice")
    for name, one in every:
        if name in values:
            held[name] = values.pop(name)
        elif one.default is not MISSING:
            held[name] = one.default
        elif one.default_factory is not MISSING:
            held[name] = one.default_factory()
        else:
            raise TypeError(f"{of.__name__}() needs {name!r}")
    for name in values:
        known = [name for name, _ in every]
        meant = did_you_mean(name, known) or f": there are {', '.join(known)}"
        raise InputError(f"{of.__name__} has no field {name!r}{meant}")
    return held


_T = TypeVar("_T")


def replace(of: _T, /, **changes: Any) -> _T:
    """Same as `dataclasses.replace`, but without `__init__`: unchanged values were accepted before."""
    fields: Any = of.__dataclass_fields__  # type: ignore[attr-defined] # every dataclass has them
    if not changes.keys() <= fields.keys():
        raise TypeError(f"{type(of).__name__} has no field {', '.join(changes.keys() - fields.keys())}")
    made, held = object.__new__(type(of)), vars(of)
    given = held if held.keys() == fields.keys() else {name: held[name] for name in fields if name in held}
    vars(made).update(given, **changes)
    if hasattr(made, "__post_init__"):
        made.__post_init__()
    return made


class Rows(Frozen):
    """N rows of parallel columns: arrays, or other rows. A single number is the same for all rows."""

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def take(self, rows: Any) -> Self:
        """Return some of the rows, by their numbers or by a mask."""
        columns = ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        parts = {
            name: column.take(rows) if isinstance(column, Rows) else column[rows]
            for name, column in columns
            if hasattr(column, "__len__")
        }
        return replace(self, **parts)


_Row = TypeVar("_Row")


def names_of(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package. What its stub `__init__.pyi` imports is loaded when
    it is first used: names, and modules in the package.
    """
    stub = Path(str(sys.modules[package].__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    homes = {name: home for home, name in re.findall(r"^from (\S+) import \w+ as (\w+)$", stub, re.MULTILINE)}

    def of_name(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}{did_you_mean(name, homes)}")
        home, here = homes[name], vars(sys.modules[package])
        here[name] = import_module(f"{package}.{name}") if home == package else getattr(import_module(home), name)
        return here[name]

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return of_name, names, [name for name, home in homes.items() if home != package]


class LazyTable(UserDict[str, _Row]):
    """A table by name. If a row is a string, the module of that name below `package` holds the row, alone or in a
    tuple: the object there of this kind and this name.
    """

    def __init__(self, package: str, rows: Mapping[str, _Row | str], kind: type[_Row]) -> None:
        self._package, self._kind = package, kind
        super().__init__(cast("Mapping[str, _Row]", rows))

    def __getitem__(self, name: str) -> _Row:
        row = self.data[name]
        if isinstance(row, str):
            held = vars(import_module(f"{self._package}.{row}")).values()
            every = (one for value in held for one in (value if isinstance(value, tuple) else (value,)))
            row = next(one for one in every if isinstance(one, self._kind) and getattr(one, "name", "") == name)
            self.data[name] = row
        return row


if TYPE_CHECKING:  # identical for a type checker
    from functools import cached_property as cached_property
else:

    class cached_property:  # noqa: N801 as the standard library writes it
        """functools.cached_property as it is from Python 3.12 on.

        Before that it holds one lock for all instances while it computes: threads wait for each other, and a process
        that is forked in the meantime waits for ever. Here two threads may both compute; both get the first value.
        """

        def __init__(self, function: Callable[[Any], Any]) -> None:
            self.func, self.__doc__ = function, function.__doc__

        def __set_name__(self, owner: type, name: str) -> None:
            self._name = name

        def __get__(self, instance: Any, owner: type | None = None) -> Any:
            if instance is None:
                return self
            return instance.__dict__.setdefault(self._name, self.func(instance))
