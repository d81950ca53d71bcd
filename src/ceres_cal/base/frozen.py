"""Frozen data: classes of annotated fields that are given once."""

from __future__ import annotations

from dataclasses import Field, FrozenInstanceError, dataclass
from dataclasses import field as field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, dataclass_transform


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field,))
class Frozen:
    """A dataclass whose instances do not change. They are equal to themselves alone, since they may hold arrays, or by
    what they hold: `class Size(Frozen, eq=True)`.

    What `dataclass(frozen=True)` writes for each class anew stands here once: a class is made three times as fast, and
    hundreds are made before a command begins.
    """

    if TYPE_CHECKING:  # msgspec reads what is annotated
        __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls, *, eq: bool = False, kw_only: bool = False, **others: Any) -> None:
        super().__init_subclass__(**others)
        dataclass(repr=False, eq=eq, unsafe_hash=eq, kw_only=kw_only)(cls)

    def __setattr__(self, name: str, value: object) -> None:
        if name in self.__dict__ or name not in self.__dataclass_fields__:
            raise FrozenInstanceError(f"cannot assign to field {name!r}")
        self.__dict__[name] = value

    def __delattr__(self, name: str) -> None:
        raise FrozenInstanceError(f"cannot delete field {name!r}")

    def __repr__(self) -> str:
        held = ", ".join(f"{name}={self.__dict__[name]!r}" for name in self.__dataclass_fields__)
        return f"{type(self).__qualname__}({held})"


_T = TypeVar("_T")


def replace(of: _T, /, **changes: Any) -> _T:
    """`dataclasses.replace`, which does not go through `__init__`: what is the same was given once already."""
    fields: Any = of.__dataclass_fields__  # type: ignore[attr-defined] # every dataclass has them
    if unknown := changes.keys() - fields.keys():
        raise TypeError(f"{type(of).__name__} has no field {', '.join(unknown)}")
    made, held = object.__new__(type(of)), vars(of)
    vars(made).update({name: held[name] for name in fields if name in held}, **changes)
    if hasattr(made, "__post_init__"):
        made.__post_init__()
    return made
