"""What every command has: a name, arguments, and an answer for people or for scripts."""

from __future__ import annotations

import argparse
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from ceres_cal.base.errors import InputError


class Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line, and which takes "-1.5,2" for the numbers they are."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # argparse's own from Python 3.14 on

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}: see `{self.prog} --help`")


@dataclass(frozen=True)
class Answer:
    """What a command found.

    Attributes:
        data: everything, for --json; numbers at full precision.
        text: makes the text for people.
        exit_code: 0, or 1 where the answer is no.
    """

    data: Mapping[str, Any]
    text: Callable[[], str]
    exit_code: int = 0


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        name: as it is typed, such as "detect board".
        summary: one line for the help.
        add_arguments: adds the command's own; --json comes from here.
        run: does the work; raises CalibrationError.
    """

    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], Answer]

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """The command's options; InputError for wrong usage. Positional arguments may stand between options."""
        parser = Parser(prog=f"ceres-cal {self.name}", description=f"{self.summary[0].upper()}{self.summary[1:]}.")
        self.add_arguments(parser)
        parser.add_argument("--json", action="store_true", help="print one JSON object")
        return parser.parse_intermixed_args(arguments)


def print_answer(answer: Answer, *, as_json: bool) -> None:
    """Print an answer; BrokenPipeError here, not at the program's end, when nobody reads on."""
    if as_json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode(answer.data), indent=1).decode())
    else:
        print(answer.text())
    sys.stdout.flush()


def add_output(parser: argparse.ArgumentParser, what: str, *, required: bool) -> None:
    """The option -o FILE."""
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=required, help=f"file for {what}")


def require_output(path: Path | None, inputs: Iterable[str | Path]) -> None:
    """Raise InputError, before any long work, where a result cannot be written or would replace an input."""
    if path is None:
        return
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot be written: there is no folder {str(path.parent)!r}: make it first")
    if path.is_dir():
        raise InputError(f"{path}: cannot be written: it is a folder: name a file in it")
    if path.exists() and any(Path(given).exists() and path.samefile(given) for given in inputs):
        raise InputError(f"{path}: is an input, and the output would replace it: name another file")


def add_report(parser: argparse.ArgumentParser) -> None:
    """The option --report PAGE."""
    parser.add_argument(
        "--report",
        metavar="PAGE",
        type=Path,
        help="file for a page (.html): may it be trusted, for what, to how many mm",
    )
    parser.add_argument(
        "--images",
        metavar="PHOTOGRAPH",
        action="append",
        default=[],
        help="with --report: a photograph, or a folder of them, named like the frames: the model is drawn into them; "
        "repeatable",
    )


def require_outputs(output: Path | None, report: Path | None, inputs: Sequence[str | Path]) -> None:
    """`require_output` of both, and that they are two files."""
    require_output(output, inputs)
    require_output(report, inputs)
    if output is not None and report is not None and output.resolve() == report.resolve():
        raise InputError(f"{report}: is named as output and as report: give them two names")


@contextmanager
def finishing() -> Iterator[None]:
    """Hold Ctrl-C back while results are written: a command that was interrupted has written nothing."""
    if threading.current_thread() is not threading.main_thread():  # where Ctrl-C does not arrive
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def written(*paths: Path | None) -> list[str]:
    """The files that were asked for, as the last section of an answer names them."""
    return [str(path) for path in paths if path is not None]


def plural(count: int, word: str) -> str:
    """A count with its word: 1 view, 2 views."""
    return f"{count} {word}{'' if count == 1 else 's'}"


def parse_number(text: str, where: str) -> float:
    """A finite number; InputError naming `where`."""
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{where}: {text.strip()!r} is not a number") from None
    if not abs(value) < float("inf"):
        raise InputError(f"{where}: {text.strip()!r} is not a finite number")
    return value


def parse_numbers(text: str, where: str) -> tuple[float, ...]:
    """Finite numbers between commas; InputError naming `where`."""
    return tuple(parse_number(part, where) for part in text.split(","))
