"""What every command has: a name, arguments, and a document that it answers, for people or for scripts.

The arguments of a command are the parameters of its function, each with its help, from which the parser is made; and,
where it shares them with others or hands all of them on, fields of a subclass of `Arguments`, which it takes as `args`.

A parameter is made by `option`, `switch` or `argument`; its type says the rest: an argument that is a tuple takes any
number, of a Literal one is chosen, and Path, int and float are read as such.
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
_GIVEN = "given"  # what was typed of options so far
_FORM = "option "  # before the names of a format's options: theirs may be those of the command's own arguments
REQUIRED: Any = MISSING
"""The default of an option that must be given."""


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
    """A field that is an option, --like-this where its name is like_this.

    Args:
        help: what it does; a function where that takes an import. Its default, where it has one, is added.
        flags: how it is typed, where otherwise. read: a value from its text, where its type does not say it.
        repeatable: whether it may be given again and again; the field is a tuple.
        group: title in the help. alone: of options of the same word one may be given. beside: names of options of which
            one has to be given, too. elsewhere: names of options of other commands that are for the same.
    """
    given = {"flags": flags, "read": read, "repeatable": repeatable, "group": group, "alone": alone}
    about = {"help": help, "metavar": metavar, "beside": beside, "elsewhere": elsewhere, **given}
    return field(default=() if repeatable and default is None else default, metadata=about)


def switch(help: str, default: bool | None = False, **about: Any) -> Any:
    """A field that is an option without a value, which makes it the contrary of its default; about: see `option`."""
    return option(help, default=default, **about)


def argument(
    metavar: str, help: str | Callable[[], str], default: Any = REQUIRED, *, read: Callable[[str], Any] | None = None
) -> Any:
    """A field that is typed without a name before it: files, where `read` says nothing else."""
    return field(default=default, metadata={"help": help, "metavar": metavar, "read": read})


def options_of(forms: Callable[[], Iterable[Any]]) -> Any:
    """A field (Mapping[str, str]) of what is given of the options of formats, as typed; what they are, formats say."""
    return field(default_factory=dict, metadata={"forms": forms})


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Arguments(Frozen, eq=True, kw_only=True):
    """What every command takes; in each class below it, too, fields are given by name."""

    json: bool = switch("print one JSON object")

    def __init_subclass__(cls) -> None:
        super().__init_subclass__(eq=True, kw_only=True)


class QuietArguments(Arguments):
    """Of a command that shows how far it is."""

    quiet: bool = switch("no progress")

    @property
    def silent(self) -> bool:
        """Whether nothing is shown on the way."""
        return self.quiet or self.json


def add_options(parser: Parser, kind: type[Arguments]) -> None:
    """Add everything that a command takes to a parser."""
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
    """The dataclass of what was typed."""
    values = vars(given)
    typed = {name.removeprefix(_FORM): text for name, text in values.items() if name.startswith(_FORM)}
    every = fields(kind)  # type: ignore[arg-type]
    of_forms = {one.name: typed for one in every if "forms" in one.metadata}
    typed_as = {one.name: values[one.name] for one in every if one.name not in of_forms}
    own = {name: tuple(value) if isinstance(value, list) else value for name, value in typed_as.items()}
    given_of = {
        name: {key: text for key, text in texts.items() if text is not None} for name, texts in of_forms.items()
    }
    return kind(**own, **given_of)


def flag(name: str) -> str:
    """How an option is typed: --error-mm of error_mm."""
    return f"--{name.replace('_', '-')}"


def given(args: Arguments) -> dict[str, Mapping[str, Any]]:
    """What was given, by name, with what was said of each where it is defined."""
    return {one.name: one.metadata for one in fields(args) if getattr(args, one.name) != one.default}


def _require_beside(args: Arguments) -> None:
    """Raise InputError for an option without the one that it belongs to."""
    every = given(args)
    for name, about in every.items():
        if (others := about.get("beside", ())) and every.keys().isdisjoint(others):
            raise InputError(f"{flag(name)} needs {' or '.join(map(flag, others))}: give both, or leave it out")


def _settings(one: Field[Any], kind: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Names and settings of an argparse argument."""
    about, item = one.metadata, _item(kind)
    how: dict[str, Any] = {"help": _help(one), "metavar": about["metavar"]}
    if get_origin(item) is Literal:
        how |= {"choices": get_args(item), "metavar": None}
    else:
        is_file = item is str and "flags" not in about
        how["type"] = about.get("read") or (_file if is_file else _READ.get(item, item))
    if "flags" not in about:
        if get_origin(kind) is tuple:
            how["nargs"] = "+" if one.default is MISSING else "*"
        elif one.default is not MISSING:
            how["nargs"] = "?"
        return (one.name,), how if one.default is MISSING else {**how, "default": one.default}
    names = about["flags"] or (flag(one.name),)
    how |= {"dest": one.name, "default": one.default}
    if item is bool:
        action = f"store_{not one.default}".lower()
        return names, {"action": action, "help": how["help"], "dest": one.name, "default": one.default}
    if one.default is MISSING:
        how |= {"required": True, "default": None}
    if about["repeatable"]:
        return names, {**how, "action": "append", "default": None if one.default is MISSING else list(one.default)}
    return names, {**how, "action": _Once}


class _Once(argparse.Action):
    """Stores what an option is given; of two values the first would be lost without a word."""

    def __call__(self, _: Any, given: argparse.Namespace, value: Any, option: str | None = None) -> None:
        before = vars(given).setdefault(_GIVEN, {}).setdefault(self.dest, value)
        if before != value:
            raise argparse.ArgumentError(self, f"it is given twice, {before} and {value}: leave one out")
        setattr(given, self.dest, value)


def _file(text: str) -> str:
    """The type of an argument that names files; no name, such as of a variable that is not set, is no folder."""
    if text in ("", "-"):
        raise argparse.ArgumentTypeError(f"{text!r} is no file: give its name (./- where that is -)")
    return text


def _number(text: str) -> float:
    """The type of an argument that is a number."""
    return finite(text, argparse.ArgumentTypeError(f"{text!r} is not a finite number"))


def whole(least: float = -float("inf"), most: float = float("inf")) -> Callable[[str], int]:
    """The type of an argument that is a whole number, in a range where that is given."""
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
    """Path, of Path | None and of tuple[Path, ...]."""
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
    """Every option of some formats, with what it means to each of them."""
    every: dict[str, dict[str, list[str]]] = {}
    for form in forms:
        for name, (_, text) in form.options.items():
            every.setdefault(name, {}).setdefault(text, []).append(form.name)
    return {name: [f"{', '.join(names)}: {text}" for text, names in of.items()] for name, of in every.items()}


class Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line, and which takes "-1.5,2" for the numbers they are."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # argparse's own from Python 3.14 on
        self.elsewhere: dict[str, str] = {}  # an option of other commands: the one of this command that is for the same

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
        work: does it; raises CalibrationError. Its parameters are its arguments, but for `args`, which is annotated
            with the dataclass of others.
        examples: of its use, without "ceres-cal" and the name, for the help. preset: what need not be typed.
    """

    name: str
    summary: str
    work: Callable[..., Document]
    examples: tuple[str, ...] = ()
    preset: tuple[str, ...] = ()

    @cached_property
    def arguments(self) -> type[Arguments]:
        """The dataclass of what is typed."""
        from inspect import signature

        types = get_type_hints(self.work)
        shared: type[Arguments] = types.get("args", Arguments)
        own = {name: one.default for name, one in signature(self.work).parameters.items() if name != "args"}
        annotated = {name: types[name] for name in own}
        return type("Typed", (shared,), {"__annotations__": annotated, **own}) if own else shared

    def run(self, args: Arguments) -> Document:
        """What it answers to its arguments."""
        names = get_type_hints(self.work).keys() - {"return"}
        return self.work(**{name: args if name == "args" else getattr(args, name) for name in names})

    def parse(self, arguments: Sequence[str]) -> Any:
        """What is typed, as `arguments`; InputError for wrong usage. Positional ones may stand between options."""
        parser = Parser(**self.about, prog=f"ceres-cal {self.name}")
        self.fill(parser)
        args = filled(self.arguments, parser.parse_intermixed_args([*self.preset, *arguments]))
        _require_beside(args)
        return args

    def answer(self, arguments: Sequence[str], *, quiet: bool = False) -> Document:
        """What it answers to what is typed; `quiet`: without showing how far it is."""
        quietly = ["--quiet"] if quiet and issubclass(self.arguments, QuietArguments) else []
        return self.run(self.parse([*arguments, *quietly]))

    def typed(self, arguments: Sequence[str]) -> str:
        """The whole of it as one types it."""
        return shlex.join(["ceres-cal", *self.name.split(), *arguments])

    @property
    def about(self) -> dict[str, Any]:
        """What a parser says of the command."""
        calls = "\n".join(f"  ceres-cal {self.name} {example}" for example in self.examples)
        return {
            "description": f"{sentence(self.summary)}.",
            "epilog": f"examples:\n{calls}",
            "formatter_class": argparse.RawDescriptionHelpFormatter,
        }

    def fill(self, parser: Parser) -> None:
        """Add all of its arguments to a parser."""
        add_options(parser, self.arguments)
        parser.add_argument("--version", action="store_true", help="print the version, and those of the libraries")


def _of_others(option: str) -> str:
    """The end of a message: of which other commands it is an option, as far as there are few."""
    owners, few = list[str](), 3
    for name, one in COMMANDS.items():
        parser = Parser(add_help=False)
        one.fill(parser)
        owners += [f"`{name}`"] * (option in parser._option_string_actions)
    return f", which is an option of {' and '.join(owners)}: leave it out" if 0 < len(owners) <= few else ""


def command(name: str, summary: str, *examples: str) -> Callable[[Callable[..., Document]], Command]:
    """Makes a command of the function that does its work."""
    return lambda work: Command(name, summary, work, examples)


# ---- the table ------------------------------------------------------------------------------------------------------


_MODULES = {
    "open": "open",
    "run": "run",
    "detect board": "photographs",
    "detect rings": "photographs",
    "detect field": "detect_field",
    "join": "join",
    "calibrate": "calibrate",
    "diagnose": "diagnose",
    "advise": "advise",
    "refit": "moves",
    "check": "moves",
    "score": "moves",
    "compare": "moves",
    "audit": "moves",
    "batch": "batch",
    "locate": "locate",
    "project": "locate",
    "undistort": "undistort",
    "export": "foreign",
    "export-table": "foreign",
    "import": "foreign",
    "publish": "foreign",
    "listen": "foreign",
    "targets import": "foreign",
    "simulate": "simulate",
    "targets": "targets",
    "targets print": "targets",
    "completion": "completion",
}


COMMANDS: Mapping[str, Command] = LazyTable("ceres_cal.cli", _MODULES, Command)
"""Every command by its name."""
