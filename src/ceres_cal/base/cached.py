"""A property that is computed once, without a lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same to a type checker
    from functools import cached_property as cached_property
else:

    class cached_property:  # noqa: N801 as the standard library writes it
        """functools.cached_property as it is from Python 3.12 on.

        Before that it holds one lock for all instances while it computes: threads wait for each other, and a process
        that is forked in the meantime waits for ever. Here two threads may both compute; both get the first value.
        """

        def __init__(self, function: Callable[[Any], Any]) -> None:
            self._function, self.__doc__ = function, function.__doc__

        def __set_name__(self, owner: type, name: str) -> None:
            self._name = name

        def __get__(self, instance: Any, owner: type | None = None) -> Any:
            if instance is None:
                return self
            return instance.__dict__.setdefault(self._name, self._function(instance))
