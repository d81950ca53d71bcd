"""Names and rows of tables whose modules are imported when they are first asked for: a start with all takes longer."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, TypeVar, cast

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
    """A table by name; of a row that is a text the module of that name, below `package`, holds the row: `found` takes
    it from there.
    """

    def __init__(self, package: str, rows: Mapping[str, Any], found: Callable[[Any, str], _Row]) -> None:
        self._package, self._found = package, found
        super().__init__(rows)

    def __getitem__(self, name: str) -> _Row:
        row: Any = self.data[name]
        if isinstance(row, str):
            row = self.data[name] = self._found(import_module(f"{self._package}.{row}"), name)
        return cast("_Row", row)
