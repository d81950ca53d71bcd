"""Commands: each has a name, arguments, and a document as its answer, for users or for scripts.

The arguments of a command are the parameters of its function, each with its help, from which the parser is made.
Arguments that commands share, or that a command passes on together, are fields of a subclass of `Arguments`, which the
function takes as `args`.

A parameter is made by `option`, `switch` or `argument`. Its type determines the rest: a tuple takes any number of
values, a Literal is a choice, and Path, int and float are parsed.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NoReturn, TypeVar, dataclass_transform, get_args, get_origin, get_type_hints

from ceres_cal.base import Frozen, InputError, LazyTable, cached_property, did_you_mean, field, finite, sentence
from ceres_cal.report.document import Document

_T = TypeVar("_T")
_GIVEN = "given"  # name under which the options typed so far are kept
_FORM = "option "  # prefix of the options of formats, whose names may be those of the command's own arguments
REQUIRED: Any = MISSING
"""Default of an option that must be given."""


def option(
    help: str | Callable[[], str] = "",
    metavar: str | None = None,
    default: Any = None,
    *,
    flags: tuple[str, ...] = (),
    read: Callable[[str], Any] | None = None,
    repeatable: bool = False,
    group: str = "",
    alone: str = "",
    beside: tuple[str, ...] = (),
    elsewhere: tuple[str, ...] = (),
) -> Any:
    """Define a field that is an option, --like-this for the name like_this.

    Args:
        help: what it does; a function if that needs an import. The default value is appended, if there is one.
        flags: how it is typed, if not by its name. read: parser of its text, if its type is not enough.
        repeatable: whether it may be given several times; the field is a tuple.
        group: title in the help. alone: only one of the options with the same word may be given.
        beside: names of options of which one must be given, too.
        elsewhere: names of options of other commands with the same purpose.
    """
    given = {"flags": flags, "read": read, "repeatable": repeatable, "group": group, "alone": alone}
    about = {"help": help, "metavar": metavar, "beside": beside, "elsewhere": elsewhere, **given}
    return field(default=() if repeatable and default is None else default, metadata=about)


def switch(help: str, default: bool | None = False, **about: Any) -> Any:
    """Define an option without a value, which inverts its default; about: see `option`."""
    return option(help, default=default, **about)


def argument(
    metavar: str, help: str | Callable[[], str], default: Any = REQUIRED, *, read: Callable[[str], Any] | None = None
) -> Any:
    """Define a positional argument: files, unless `read` says otherwise."""
    return field(default=default, metadata={"help": help, "metavar": metavar, "read": read})


def options_of(forms: Callable[[], Iterable[Any]]) -> Any:
    """Define a field (Mapping[str, str]) of the given options of formats, as typed; formats define these options."""
    return field(default_factory=dict, metadata={"forms": forms})


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Arguments(Frozen, eq=True, kw_only=True):
    """Arguments of every command; in each subclass, too, fields are given by name."""

    json: bool = switch("print one JSON object")

    def __init_subclass__(cls) -> None:
        super().__init_subclass__(eq=True, kw_only=True)


class QuietArguments(Arguments):
    """Arguments of a command that shows progress."""

    quiet: bool = switch("no progress")

    @property
    def silent(self) -> bool:
        """Whether no progress is shown."""
        return self.quiet or self.json


def add_options(parser: Parser, kind: type[Arguments]) -> None:
    """Add all arguments of a command to a parser."""
    types, places = get_type_hints(kind), {"": parser}
    common = {one.name for one in fields(QuietArguments)}
    for one in sorted(fields(kind), key=lambda one: one.name in common):
        about = one.metadata
        if "forms" in about:
            for name, helps in _of_forms(about["forms"]()).items():
                how: dict[str, Any] = {"metavar": "VALUE", "help": _escaped("; ".join(helps))}
                parser.add_argument(flag(name), dest=_FORM + name, action=_Once, **how)
            continue
        place: Any = parser
        if title := about.get("group"):
            place = places.get(title) or places.setdefault(title, parser.add_argument_group(title))  # type: ignore[arg-type]
        if word := about.get("alone"):
            place = places.get(word) or places.setdefault(word, place.add_mutually_exclusive_group())
        names, how = _settings(one, types[one.name])
        place.add_argument(*names, **how)
        parser.elsewhere |= {flag(other): names[-1] for other in about.get("elsewhere", ())}


def filled(kind: type[_T], given: argparse.Namespace) -> _T:
    """Make the dataclass from what was typed."""
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in vars(given).items()}
    every = {name: value for name, value in values.items() if name.startswith(_FORM) and value is not None}
    of_forms = {name.removeprefix(_FORM): text for name, text in every.items()}
    own: Any = fields(kind)  # type: ignore[arg-type]
    return kind(**{one.name: of_forms if "forms" in one.metadata else values[one.name] for one in own})


def flag(name: str) -> str:
    """Return how an option is typed: --error-mm for error_mm."""
    return f"--{name.replace('_', '-')}"


def given(args: Arguments) -> dict[str, Mapping[str, Any]]:
    """Return the arguments that differ from their defaults, by name, with their definitions."""
    return {one.name: one.metadata for one in fields(args) if getattr(args, one.name) != one.default}


def _require_beside(args: Arguments) -> None:
    """Raise InputError for an option without one that it requires."""
    every = given(args)
    for name, about in every.items():
        if (others := about.get("beside", ())) and every.keys().isdisjoint(others):
            raise InputError(f"{flag(name)} needs {' or '.join(map(flag, others))}: give both, or leave it out")


def _settings(one: Field[Any], kind: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return names and settings of an argparse argument."""
    about, item, needed = one.metadata, _item(kind), one.default is MISSING
    how: dict[str, Any] = {"help": _help(one), "metavar": about["metavar"], "default": None if needed else one.default}
    if get_origin(item) is Literal:
        how |= {"choices": get_args(item), "metavar": None}
    else:
        is_file = item is str and "flags" not in about
        how["type"] = about.get("read") or (_file if is_file else _READ.get(item, item))
    if "flags" not in about:
        if get_origin(kind) is tuple:
            how["nargs"] = "+" if needed else "*"
        elif not needed:
            how["nargs"] = "?"
        return (one.name,), how
    names = about["flags"] or (flag(one.name),)
    if item is bool:
        action = f"store_{not one.default}".lower()
        return names, {"action": action, "help": how["help"], "dest": one.name, "default": one.default}
    how |= {"dest": one.name, "required": needed}
    if about["repeatable"]:
        return names, {**how, "action": "append", "default": None if needed else list(how["default"])}
    return names, {**how, "action": _Once}


class _Once(argparse.Action):
    """Stores the value of an option, and refuses a second, different one, as the first would be lost silently."""

    def __call__(self, _: Any, given: argparse.Namespace, value: Any, option: str | None = None) -> None:
        before = vars(given).setdefault(_GIVEN, {}).setdefault(self.dest, value)
        if before != value:
            raise argparse.ArgumentError(self, f"it is given twice, {before} and {value}: leave one out")
        setattr(given, self.dest, value)


def _file(text: str) -> str:
    """The type of an argument that names files; an empty name, such as of an unset variable, is refused."""
    if text in ("", "-"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a file: give its name (./- where that is -)")
    return text


def _number(text: str) -> float:
    """The type of an argument that is a number."""
    return finite(text, argparse.ArgumentTypeError(f"{text!r} is not a finite number"))


def whole(least: float = -float("inf"), most: float = float("inf")) -> Callable[[str], int]:
    """Return the type of an argument that is a whole number, possibly in a range."""
    range_words = (f" of {least} or more" if most > 1e9 else f" from {least} to {most}") if abs(least) < 1e9 else ""

    def parse(text: str) -> int:
        if not re.fullmatch(r"-?\d+", text) or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number{range_words}")
        return int(text)

    return parse


_READ: dict[Any, Callable[[str], Any]] = {
    Path: lambda text: Path(_file(text)),
    int: whole(),
    float: _number,
}


def _item(kind: Any) -> Any:
    """Path, for Path | None and for tuple[Path, ...]."""
    inner = [one for one in get_args(kind) if one not in (NoneType, Ellipsis)]
    return kind if get_origin(kind) is Literal or not inner else _item(inner[0])


def _help(one: Field[Any]) -> str:
    about = one.metadata
    text: str = about["help"]() if callable(about["help"]) else about["help"]
    more = ["repeatable"] if about.get("repeatable") and "repeatable" not in text else []
    says_nothing = isinstance(one.default, bool) or one.default in (MISSING, None, "", ())
    if not says_nothing and "default" not in text and "flags" in about:
        more.append(f"default: {one.default:g}" if isinstance(one.default, float) else f"default: {one.default}")
    return _escaped("; ".join(part for part in (text, *more) if part))


def _escaped(text: str) -> str:
    return text.replace("%", "%%")


def _of_forms(forms: Iterable[Any]) -> Mapping[str, list[str]]:
    """Return every option of some formats, with its meaning for each of them."""
    every: dict[str, dict[str, list[str]]] = {}
    for form in forms:
        for name, (_, text) in form.options.items():
            every.setdefault(name, {}).setdefault(text, []).append(form.name)
    return {name: [f"{', '.join(names)}: {text}" for text, names in of.items()] for name, of in every.items()}


class Parser(argparse.ArgumentParser):
    """argparse with errors of one line, which accepts "-1.5,2" as numbers."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # the same as argparse's from Python 3.14 on
        self.elsewhere: dict[str, str] = {}  # option of other commands -> this command's option with the same purpose

    def error(self, message: str) -> NoReturn:
        meant = ""
        if wrong := re.match(r"unrecognized arguments: (-[\w-]+)", message):
            own = self.elsewhere.get(wrong[1])
            meant = f": here it is {own}" if own else _of_others(wrong[1])
            meant = meant or did_you_mean(wrong[1], self._option_string_actions)
        elif wrong := re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message):
            meant = did_you_mean(wrong[1], re.findall(r"[\w.-]+", wrong[2]))
        raise InputError(f"{message}{meant or f': see `{self.prog} --help`'}")


class Command(Frozen, eq=True):
    """One command.

    Attributes:
        name: as it is typed, such as "detect board".
        summary: one line for the help.
        work: function that does the work; raises CalibrationError. Its parameters are the arguments, except `args`,
            which is annotated with the dataclass of shared ones.
        examples: of its use, without "ceres-cal" and the name, for the help. preset: arguments that need not be typed.
    """

    name: str
    summary: str
    work: Callable[..., Document]
    examples: tuple[str, ...] = ()
    preset: tuple[str, ...] = ()

    @cached_property
    def arguments(self) -> type[Arguments]:
        """The dataclass of the arguments."""
        from inspect import signature

        types = get_type_hints(self.work)
        shared: type[Arguments] = types.get("args", Arguments)
        own = {name: one.default for name, one in signature(self.work).parameters.items() if name != "args"}
        annotated = {name: types[name] for name in own}
        return type("Typed", (shared,), {"__annotations__": annotated, **own}) if own else shared

    def run(self, args: Arguments) -> Document:
        """Return the answer to the arguments."""
        names = get_type_hints(self.work).keys() - {"return"}
        return self.work(**{name: args if name == "args" else getattr(args, name) for name in names})

    def parse(self, arguments: Sequence[str]) -> Any:
        """Parse typed arguments; InputError for wrong usage. Positional arguments may stand between options."""
        parser = Parser(**self.about, prog=f"ceres-cal {self.name}")
        self.fill(parser)
        args = filled(self.arguments, parser.parse_intermixed_args([*self.preset, *arguments]))
        _require_beside(args)
        return args

    def answer(self, arguments: Sequence[str], *, quiet: bool = False) -> Document:
        """Return the answer to typed arguments; `quiet`: without progress."""
        quietly = ["--quiet"] if quiet and issubclass(self.arguments, QuietArguments) else []
        return self.run(self.parse([*arguments, *quietly]))

    def typed(self, arguments: Sequence[str]) -> str:
        """Return the whole command line."""
        return shlex.join(["ceres-cal", *self.name.split(), *arguments])

    @property
    def about(self) -> dict[str, Any]:
        """Settings of the command's parser."""
        calls = "\n".join(f"  ceres-cal {self.name} {example}" for example in self.examples)
        return {
            "description": f"{sentence(self.summary)}.",
            "epilog": f"examples:\n{calls}",
            "formatter_class": argparse.RawDescriptionHelpFormatter,
        }

    def fill(self, parser: Parser) -> None:
        """Add all arguments of the command to a parser."""
        add_options(parser, self.arguments)
        parser.add_argument("--version", action="store_true", help="print the version, and those of the libraries")


def _of_others(option: str) -> str:
    """End of a message: the other commands that have the option, if there are few."""
    owners, few = list[str](), 3
    for name, one in COMMANDS.items():
        parser = Parser(add_help=False)
        one.fill(parser)
        owners += [f"`{name}`"] * (option in parser._option_string_actions)
    return f", which is an option of {' and '.join(owners)}: leave it out" if 0 < len(owners) <= few else ""


def command(name: str, summary: str, *examples: str) -> Callable[[Callable[..., Document]], Command]:
    """Make a command of the function that does its work."""
    return lambda work: Command(name, summary, work, examples)


# ---- the table ------------------------------------------------------------------------------------------------------


_COMMANDS_OF = {
    "open": ("open",),
    "run": ("run",),
    "photographs": ("detect board", "detect rings"),
    "detect_field": ("detect field",),
    "join": ("join",),
    "calibrate": ("calibrate",),
    "diagnose": ("diagnose",),
    "advise": ("advise",),
    "moves": ("refit", "check", "score", "compare", "audit"),
    "batch": ("batch",),
    "locate": ("locate", "project"),
    "undistort": ("undistort",),
    "foreign": ("export", "export-table", "import", "publish", "listen", "targets import"),
    "simulate": ("simulate",),
    "targets": ("targets", "targets print"),
    "completion": ("completion",),
}
"""Commands of each module, in the order of the help."""
_MODULES = {name: module for module, names in _COMMANDS_OF.items() for name in names}
COMMANDS: Mapping[str, Command] = LazyTable("ceres_cal.cli", _MODULES, Command)
"""All commands by name."""
