"""Options of commands: a parser made from a dataclass, and the dataclass filled by it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import pytest

from ceres_cal.base.errors import InputError
from ceres_cal.base.frozen import Frozen
from ceres_cal.cli.arguments import ReportArguments, length
from ceres_cal.cli.calibrate import CalibrateArguments
from ceres_cal.cli.command import (
    COMMANDS,
    REQUIRED,
    Arguments,
    Parser,
    QuietArguments,
    add_options,
    argument,
    filled,
    given,
    option,
    options_of,
    switch,
)
from ceres_cal.problem.parameters import AUTO, Options


@dataclass(frozen=True)
class Form:
    """A format."""

    name: str = "table"
    options: Mapping[str, tuple[Any, str]] = field(default_factory=lambda: {"error_mm": (float, "")})


class EveryFieldType(QuietArguments):
    """One field of each kind."""

    first: Path = argument("FIRST", "a file")
    rest: tuple[int, ...] = argument("N", "numbers", ())
    count: int = option("how many", "N", 3)
    scale: float | None = option("none is given", "X")
    size: float = option("100 % of it", "MM", REQUIRED, read=length("mm"))
    kind: Literal["a", "b"] = option("one of these", default="a")
    name: tuple[str, ...] = option("names", "NAME", repeatable=True)
    holds: bool = switch("holds")
    usual: bool = switch("nothing is usual", default=True, flags=("--no-usual",), group="more")
    one: bool = switch("this", alone="either")
    other: bool = switch("or that", alone="either")
    form: Mapping[str, str] = options_of(lambda: [Form()])


def read(*arguments: str) -> EveryFieldType:
    parser = Parser(prog="every")
    add_options(parser, EveryFieldType)
    return filled(EveryFieldType, parser.parse_intermixed_args(arguments))


def test_what_is_left_out_is_the_default() -> None:
    assert read("x", "--size", "2") == EveryFieldType(first=Path("x"), size=2.0)
    assert {one.name: one.default for one in fields(EveryFieldType)}["count"] == 3


def test_everything_has_its_type() -> None:
    typed = (
        "x 1 --size 2cm 2 --count 4 --scale .5 --kind b --name p --name q --holds --no-usual --one --error-mm 9 --quiet"
    )
    args = read(*typed.split())
    assert args == EveryFieldType(
        first=Path("x"), rest=(1, 2), count=4, scale=0.5, size=20.0, kind="b", name=("p", "q"), holds=True, usual=False,
        one=True, form={"error_mm": "9"}, quiet=True,
    )  # fmt: skip
    assert given(args)["usual"]["group"] == "more" and given(read("x", "--size", "2")).keys() == {
        "first",
        "size",
        "form",
    }


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--size", "1"), "required: FIRST"),
        (("x",), "required: --size"),
        (("x", "--size", "wide"), "'wide' is not a length"),
        (("x", "--size", "1", "--count", "a"), "--count: 'a' is not a whole number"),
        (("x", "--size", "1", "--kind", "c"), "invalid choice: 'c'"),
        (("x", "--size", "1", "--one", "--other"), "not allowed with"),
        (("x", "--size", "1", "--cou", "1"), "unrecognized arguments: --cou"),
    ],
)
def test_wrong_usage(arguments: Sequence[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        read(*arguments)


def test_the_help_says_the_default_and_what_may_be_repeated() -> None:
    parser = Parser()
    add_options(parser, EveryFieldType)
    said = parser.format_help()
    for words in (
        "how many; default: 3",
        "names; repeatable",
        "100 % of it",
        "table: ",
        "more:",
        "print one JSON object",
    ):
        assert words in " ".join(said.split()), words
    assert "default: None" not in said and "default: False" not in said


# ---- the commands' own ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_every_argument_of_a_command_is_described_where_it_is_defined(name: str) -> None:
    kind = COMMANDS[name].arguments
    assert issubclass(kind, Arguments) and issubclass(kind, Frozen)
    parser = Parser()
    add_options(parser, kind)
    helps = {action.dest: action.help for action in parser._actions}
    assert all(helps[one.name] or one.metadata["metavar"] for one in fields(kind) if "forms" not in one.metadata)


def test_what_calibrate_hands_on_has_the_same_defaults_as_in_python() -> None:
    """Fields with the name of an option of `Options` are passed on unchanged, except those that are parsed further."""
    shared: dict[str, Any] = {one.name: one.default for one in fields(CalibrateArguments)}
    parsed = {"lens", "powers", "terms", "as_built"}
    own = {one.name: one.default for one in fields(Options)}
    same = own.keys() & shared.keys() - parsed
    assert {"loss", "loss_scale", "reject_sigma", "noise_scale", "max_iterations", "threads", "usual_camera"} <= same
    assert {name: shared[name] for name in same} == {name: own[name] for name in same}
    assert Options().lens == AUTO and shared["lens"] is None


def test_commands_that_write_a_report_say_where() -> None:
    assert [name for name in COMMANDS if issubclass(COMMANDS[name].arguments, ReportArguments)] == [
        "calibrate", "diagnose", "refit",
    ]  # fmt: skip
