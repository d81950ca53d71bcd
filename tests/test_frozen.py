"""Frozen data: immutable, and by default equal only to itself."""

from __future__ import annotations

import copy
import inspect
import pickle
import pkgutil
import pydoc
from dataclasses import FrozenInstanceError, fields
from importlib import import_module
from typing import ClassVar

import msgspec
import numpy as np
import pytest

import ceres_cal
from ceres_cal.base.arrays import Array
from ceres_cal.base.frozen import Frozen, cached_property, field, replace


class Ring(Frozen):
    """A ring."""

    kind: ClassVar[str] = "ring"
    places: Array
    name: str = "ring"
    notes: list[str] = field(default_factory=list)

    @cached_property
    def size(self) -> int:
        return len(self.places)


class Size(Frozen, eq=True):
    """A size."""

    width: int
    height: int = 1


class ColouredRing(Ring, kw_only=True):
    """A ring with a keyword-only number."""

    colour: int


def test_what_is_given_does_not_change() -> None:
    ring = Ring(np.zeros(3))
    for name in ("places", "name", "size", "other"):
        with pytest.raises(FrozenInstanceError, match=name):
            setattr(ring, name, None)
        with pytest.raises(FrozenInstanceError, match=name):
            delattr(ring, name)
    assert ring.size == 3
    assert ring.name == "ring"
    assert not ring.notes


def test_it_is_equal_to_itself_alone() -> None:
    ring = Ring(np.zeros(3))
    assert ring == ring
    assert ring != replace(ring)
    assert len({ring, replace(ring)}) == 2


def test_or_by_what_it_holds() -> None:
    assert Size(2) == Size(2, 1) != Size(2, 2)
    assert {Size(2): "a"}[Size(2, 1)] == "a"


def test_it_is_a_dataclass_to_everybody() -> None:
    ring = ColouredRing(np.zeros(2), "red", colour=1)
    assert [one.name for one in fields(ring)] == ["places", "name", "notes", "colour"]
    assert replace(ring, colour=2).colour == 2
    assert repr(ring) == "ColouredRing(places=array([0., 0.]), name='red', notes=[], colour=1)"
    long = repr(replace(ring, places=np.zeros(300)))  # a line for each part
    assert long == "ColouredRing(\n  places=<array 300>\n  name='red'\n  notes=[]\n  colour=1)"
    for again in (copy.copy(ring), pickle.loads(pickle.dumps(ring))):
        assert (again.name, again.colour, again.size) == ("red", 1, 2)
    with pytest.raises(TypeError, match="colour"):
        ColouredRing(np.zeros(2))  # type: ignore[call-arg]


def test_what_a_file_leaves_out_is_the_default() -> None:
    """msgspec stores no default in an instance; it is found in the class."""
    read = msgspec.convert({"width": 2}, Size)
    assert read == Size(2) and repr(read) == repr(Size(2)) and replace(read, width=3) == Size(3)


def test_a_default_is_a_value_of_the_class() -> None:
    """`run` for a folder of cameras reads defaults from its class, and found none."""

    class NameHolder(Frozen):
        name: str = field(default="ring", metadata={"help": "what it is called"})
        notes: list[str] = field(default_factory=list)

    assert NameHolder.name == NameHolder().name == "ring"
    assert not hasattr(NameHolder, "notes")


def test_help_shows_it() -> None:
    """`help(cc.Options)` ended in a TypeError about dataclasses."""
    text = pydoc.plain(pydoc.render_doc(ColouredRing))
    assert "ColouredRing(places: 'Array', name: 'str' = 'ring'," in text and "colour: 'int')" in text


def test_help_shows_every_class() -> None:
    """`help(cc.formats)` ended in a NameError: msgspec evaluates annotations that only type checkers import."""
    homes = [
        module.name for module in pkgutil.walk_packages(ceres_cal.__path__, "ceres_cal.") if "__" not in module.name
    ]
    every = [held for home in homes for held in vars(import_module(home)).values() if inspect.isclass(held)]
    ours = {held for held in every if held.__module__.startswith("ceres_cal.") and not issubclass(held, BaseException)}
    assert len(ours) > 300
    for held in ours:
        inspect.signature(held)
