"""What is computed, or imported, when it is first asked for: properties, names of a package, rows of tables."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar, cast

from ceres_cal.base.words import did_you_mean

_Row = TypeVar("_Row")


def names_of(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package: name -> module, below the package, that defines it."""

    def of_name(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}{did_you_mean(name, homes)}")
        return getattr(import_module(f"{package}.{homes[name]}"), name)

    return of_name


class LazyTable(UserDict[str, _Row]):
    """A table by name; of a row that is a text the module of that name, below `package`, holds the row: what is of the
    kind there, and of that name.
    """

    def __init__(self, package: str, rows: Mapping[str, _Row | str], kind: type[_Row]) -> None:
        self._package, self._kind = package, kind
        super().__init__(cast("Mapping[str, _Row]", rows))

    def __getitem__(self, name: str) -> _Row:
        row = self.data[name]
        if isinstance(row, str):
            held = vars(import_module(f"{self._package}.{row}")).values()
            row = next(one for one in held if isinstance(one, self._kind) and getattr(one, "name", "") == name)
            self.data[name] = row
        return row


if TYPE_CHECKING:  # the same to a type checker
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
