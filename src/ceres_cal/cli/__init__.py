"""The commands: `ceres-cal COMMAND ...` (design, section 11).

Only argparse is imported here and at the top of the commands' modules, so that help and wrong usage answer at once; and
of these only the one whose command is typed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from ceres_cal.base.errors import CalibrationError, InputError, SolutionError
from ceres_cal.base.progress import noting
from ceres_cal.base.words import did_you_mean, first_of
from ceres_cal.cli.command import COMMANDS, Command
from ceres_cal.cli.terminal import TERMINATED, Terminated, as_a_program, ended, error, in_colour, print_answer

_BEGINNINGS = {"", *(name.partition(" ")[0] for name in COMMANDS if " " in name)}
_FORESEEN = (CalibrationError, KeyboardInterrupt, MemoryError, OSError)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Args:
        arguments: those of the command line by default.

    Returns:
        0 success, 1 the answer is no or a part of it could not be made, 2 bad usage or input, 3 no usable solution,
        130 interrupted, 143 terminated.
        It says how the work ended, whether or not its words could be written. Every failure is one line on standard
        error, with --json also an object on standard output; with CERES_CAL_DEBUG set an unexpected one is raised
        instead.
    """
    if arguments is not None:
        return _answer(list(arguments))
    as_a_program()
    return ended(_answer(sys.argv[1:]))


def _answer(arguments: list[str]) -> int:
    """Run one command; the exit code, whatever happens."""
    with noting() as files:
        try:
            return _run(arguments)
        except SystemExit as done:  # quiet: argparse has printed its help
            return int(done.code or 0)
        except (Exception, KeyboardInterrupt) as error:  # reads: "ceres-cal: ..." on standard error
            if os.environ.get("CERES_CAL_DEBUG") and not isinstance(error, _FORESEEN):
                raise
            return _fail(*_words(error, files), "--json" in arguments)


def _words(error: BaseException, files: Sequence[str]) -> tuple[str, int]:
    """What is said of an error, and the exit code."""
    interrupted = 130  # what a shell reports of a program that SIGINT ended
    most_letters = 200  # of an error that nobody wrote for people
    match error:
        case CalibrationError():
            return str(error), error.exit_code
        case KeyboardInterrupt():
            how, code = ("terminated", TERMINATED) if isinstance(error, Terminated) else ("interrupted", interrupted)
            return f"{how}: {f'written were {first_of(files)}' if files else 'nothing was written'}", code
        case MemoryError():
            return "out of memory: give fewer observations or images at a time", InputError.exit_code
        case OSError():
            parts = (error.filename, error.strerror or error)
            return ": ".join(str(part) for part in parts if part), InputError.exit_code
    what = f"{type(error).__name__}: {error}"[:most_letters]
    return f"unexpected {what}: please report it (CERES_CAL_DEBUG=1 tells more)", SolutionError.exit_code


def _fail(message: str, exit_code: int, as_json: bool) -> int:
    line = " ".join(message.splitlines())
    said = f"ceres-cal: {line}"
    print(error(said) if in_colour(sys.stderr) else said, file=sys.stderr)
    if as_json:
        import json

        print(json.dumps({"error": line, "exit_code": exit_code}), flush=True)
    return exit_code


def _run(arguments: list[str]) -> int:
    beginning = " ".join(arguments[:-1])
    if arguments[-1:] in (["-h"], ["--help"]) and beginning in _BEGINNINGS and beginning not in COMMANDS:
        print(_overview(beginning))
        return 0
    if "--version" in arguments:
        from ceres_cal.calibration import package_versions

        print(", ".join(f"{name} {version}" for name, version in package_versions().items()))
        return 0
    command, rest = chosen(arguments)
    options = command.parse(rest)
    answer = command.run(options)
    print_answer(answer, as_json=options.json, quiet=getattr(options, "quiet", False))
    return answer.exit_code


def chosen(arguments: list[str]) -> tuple[Command, list[str]]:
    """The command that is typed, and its arguments; InputError where there is none of its name."""
    for words in (2, 1):
        command = COMMANDS.get(" ".join(arguments[:words]))
        if command is not None:
            return command, arguments[words:]
    if not arguments:
        raise InputError("which command? See `ceres-cal --help`")
    if arguments[0] in _BEGINNINGS:
        below = [name for name in COMMANDS if name.startswith(f"{arguments[0]} ")]
        meant = did_you_mean(" ".join(arguments[:2]), below) if arguments[1:] else ""
        listed = f": one of {', '.join(below)}?"
        raise InputError(f"{arguments[0]} what{meant or listed}")
    typed = arguments[0] if arguments[0].startswith("-") else " ".join(arguments[:2])
    meant = did_you_mean(typed, COMMANDS) or did_you_mean(arguments[0], COMMANDS)
    raise InputError(f"there is no command {arguments[0]!r}{meant or ': see `ceres-cal --help`'}")


def _overview(beginning: str) -> str:
    summaries = {name: command.summary for name, command in COMMANDS.items() if name.startswith(beginning)}
    width = max(map(len, summaries))
    return "\n".join(
        [
            "usage: ceres-cal COMMAND ... [--json] [--version]",
            "",
            "Calibrate an overhead camera from corners, lines and arcs of a flat field.",
            "",
            *(f"  {name:{width}}  {summary}" for name, summary in summaries.items()),
            "",
            "`ceres-cal COMMAND --help` tells how. Every command prints one JSON object with --json.",
            "Exit codes: 0 success, 1 the answer is no or not whole, 2 bad usage or input, 3 no usable solution.",
        ]
    )
