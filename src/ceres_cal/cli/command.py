"""What every command has: a name, arguments, and a document that it answers, for people or for scripts."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, get_type_hints

from ceres_cal.base.errors import InputError
from ceres_cal.base.lazy import LazyTable
from ceres_cal.base.words import did_you_mean, sentence
from ceres_cal.cli.options import Arguments, add_options, filled
from ceres_cal.cli.terminal import coloured, in_colour
from ceres_cal.report.document import Document


class Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line, and which takes "-1.5,2" for the numbers they are."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # argparse's own from Python 3.14 on

    def error(self, message: str) -> NoReturn:
        meant = ""
        if wrong := re.match(r"unrecognized arguments: (-[\w-]+)", message):
            meant = did_you_mean(wrong[1], self._option_string_actions)
        elif wrong := re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message):
            meant = did_you_mean(wrong[1], re.findall(r"[\w.-]+", wrong[2]))
        raise InputError(f"{message}{meant or f': see `{self.prog} --help`'}")


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        name: as it is typed, such as "detect board".
        summary: one line for the help.
        run: does the work; raises CalibrationError. Its argument `args` is annotated with the dataclass that it takes.
        examples: of its use, without "ceres-cal" and the name, for the help.
    """

    name: str
    summary: str
    run: Callable[[Any], Document]
    examples: tuple[str, ...] = ()

    @property
    def arguments(self) -> type[Arguments]:
        """The dataclass that it takes."""
        kind: type[Arguments] = get_type_hints(self.run)["args"]
        return kind

    def parse(self, arguments: Sequence[str]) -> Any:
        """What is typed, as `arguments`; InputError for wrong usage. Positional ones may stand between options."""
        parser = Parser(**self.about, prog=f"ceres-cal {self.name}")
        self.fill(parser)
        return filled(self.arguments, parser.parse_intermixed_args(arguments))

    @property
    def about(self) -> dict[str, Any]:
        """What a parser says of the command."""
        calls = "\n".join(f"  ceres-cal {self.name} {example}" for example in self.examples)
        return {
            "description": f"{sentence(self.summary)}.",
            "epilog": f"examples:\n{calls}",
            "formatter_class": argparse.RawDescriptionHelpFormatter,
        }

    def fill(self, parser: argparse.ArgumentParser) -> None:
        """Add all of its arguments to a parser."""
        add_options(parser, self.arguments)
        parser.add_argument("--version", action="store_true", help="print the version, and those of the libraries")


def command(name: str, summary: str, *examples: str) -> Callable[[Callable[[Any], Document]], Command]:
    """Makes a command of the function that does its work."""
    return lambda run: Command(name, summary, run, examples)


def print_answer(answer: Document, *, as_json: bool, quiet: bool = False) -> None:
    """Print an answer; with --quiet its one line."""
    if quiet and not as_json:
        print(answer.one_line)
    elif as_json:
        from ceres_cal.base.files import json_text

        print(json_text(answer.data))
    else:
        text = answer.text()
        print(coloured(text) if in_colour(sys.stdout) else text)


# ---- the table ------------------------------------------------------------------------------------------------------


_MODULES = {
    "open": "open",
    "run": "run",
    "detect board": "detect",
    "detect rings": "detect_rings",
    "detect field": "detect_field",
    "join": "join",
    "calibrate": "calibrate",
    "diagnose": "diagnose",
    "advise": "advise",
    "refit": "refit",
    "check": "check",
    "score": "score",
    "compare": "compare",
    "audit": "audit",
    "batch": "batch",
    "locate": "locate",
    "project": "locate",
    "undistort": "undistort",
    "export": "export",
    "export-table": "export",
    "import": "foreign",
    "publish": "foreign",
    "listen": "foreign",
    "targets import": "foreign",
    "simulate": "simulate",
    "targets": "targets",
    "targets print": "targets",
    "completion": "completion",
}


def _command_of(module: Any, name: str) -> Command:
    return next(one for one in vars(module).values() if isinstance(one, Command) and one.name == name)


COMMANDS: Mapping[str, Command] = LazyTable("ceres_cal.cli", _MODULES, _command_of)
"""Every command by its name."""
