"""Output to a terminal: colour, unless NO_COLOR forbids it, and progress on standard error.

Progress is a bar on a terminal, occasional lines elsewhere, and nothing where it is not wanted. Colour marks titles,
warnings, and whether the answer is good.

Also the commands as a program: the choice of the command, signals, streams, error messages and exit.
"""

from __future__ import annotations

import atexit
import gc
import io
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Sequence
from select import select
from types import FrameType
from typing import Any, NoReturn, TextIO, cast

from ceres_cal import base, calibration
from ceres_cal.base import CalibrationError, InputError, SolutionError, did_you_mean, noted_words, noting
from ceres_cal.cli.command import COMMANDS, Command
from ceres_cal.report.document import Document

_BOLD, _RED, _GREEN, _YELLOW, _PLAIN = "\x1b[1m", "\x1b[31m", "\x1b[32m", "\x1b[33m", "\x1b[0m"
_CLEAR = "\r\x1b[K"
_TITLE = re.compile(r"^([a-z][a-z ]{0,8})(?=[ ]*(?<=^.{10})\S)", re.MULTILINE)
_DOUBTFUL = {"warning", "weak", "unknown", "widened"}
_ANSWERS = (
    (_GREEN, re.compile(r"^(?:verdict +This calibration can be trusted|(?:check|audit) +yes).*$", re.MULTILINE)),
    (_YELLOW, re.compile(r"^verdict +Usable (?:with limits|on the floor).*$", re.MULTILINE)),
    (_RED, re.compile(r"^(?:verdict +Do not trust|(?:check|audit) +no\b).*$", re.MULTILINE)),
)


def in_colour(stream: TextIO) -> bool:
    """Whether a stream shows colours and no environment variable forbids them (no-color.org)."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def coloured(text: str) -> str:
    """Colour the text of an answer."""
    for colour, answer in _ANSWERS:
        text = answer.sub(rf"{colour}\g<0>{_PLAIN}", text)
    return _TITLE.sub(_title, text)


def _title(found: re.Match[str]) -> str:
    title = found[1].rstrip()
    colour = _YELLOW if title in _DOUBTFUL else _BOLD
    return f"{colour}{title}{_PLAIN}{found[1][len(title) :]}"


# ---- progress -------------------------------------------------------------------------------------------------------


class ProgressBar:
    """Progress of long work. Used as a context, it removes the bar at the end in any case.

    Args:
        silent: show nothing.
        stream: where to show it; standard error by default.
        clock: current time in seconds.
    """

    def __init__(
        self, silent: bool, *, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        first_line_s = 3.0  # without a terminal; the interval doubles with each line
        redraw_s = 0.1
        self._stream = sys.stderr if stream is None else stream
        self._silent, self._clock = silent, clock
        self._terminal = self._stream.isatty() and os.environ.get("TERM") != "dumb"
        self._wait = redraw_s if self._terminal else first_line_s
        self._due = clock() + (0.0 if self._terminal else self._wait)

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal and not self._silent:
            self._write(_CLEAR)

    def say(self, text: str) -> None:
        """Print a line that stays."""
        if not self._silent:
            self._write(f"{_CLEAR if self._terminal else ''}{text}\n")

    def update(self, done: int, total: int, note: str) -> None:
        """Show that `done` of `total` steps are done, total 0 if it is unknown; `note` describes the current work."""
        now = self._clock()
        if self._silent or now < self._due:
            return
        if self._terminal:
            import shutil

            bar = f"{_bar(done, total)} {note}" if total else note
            self._write(_CLEAR + bar[: shutil.get_terminal_size().columns - 1])
        else:
            self._write(f"{note} ({done} of {total})\n" if total else f"{note}\n")
            self._wait *= 2.0
        self._due = now + self._wait

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def _bar(done: int, total: int) -> str:
    bar_columns = 24
    full = bar_columns * done // total
    return f"[{'#' * full}{'.' * (bar_columns - full)}] {100 * done // total:3} %"


TERMINATED = 143
"""Exit code that a shell reports for a program ended by SIGTERM."""


class Termination(KeyboardInterrupt):
    """SIGTERM arrived: the program ends as by Ctrl-C."""


class _SafeStream(io.FileIO):
    """A standard stream that never fails: what cannot be written is lost, and `lost` says why.

    So the exit code of a command depends on its work alone, not on its output.
    """

    lost: OSError | None = None

    def write(self, content: Any) -> int:
        try:
            while self.lost is None:
                if (written := super().write(content)) is not None:
                    return written
                select([], [self], [])  # a non-blocking pipe that is full
        except OSError as error:  # reads: "the answer is not on standard output: ..."
            self.lost = error
        return len(content)


def as_a_program() -> None:
    """Treat SIGTERM like Ctrl-C, make any name printable on any stream, and keep libraries from writing to standard
    error.
    """
    # Allocations between garbage collections: `calibrate` makes half as many objects, none of them garbage, and a
    # collection takes 20 ms.
    objects = 100_000
    signal.signal(signal.SIGTERM, _terminate)
    gc.set_threshold(objects)
    for threads in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(threads, "1")  # starting other threads, which gain little (base.threads), takes time
    _open_what_is_closed()
    error = 2
    if not os.environ.get("CERES_CAL_DEBUG"):
        error = os.dup(2)
        _silence_libraries()
    sys.stdout, sys.stderr = _stream(1, sys.stdout), _stream(error, sys.stderr)


def _open_what_is_closed() -> None:
    """Open closed standard descriptors; otherwise the next opened file would receive standard output or error."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)


def _stream(number: int, before: TextIO | None) -> TextIO:
    """Make a stream of a descriptor, like the one before, or a usual one if there was none."""
    encoding = "utf-8" if before is None else before.encoding
    buffered = io.BufferedWriter(_SafeStream(number, "w", closefd=False))
    by_lines = number != 1 or os.isatty(number)
    return io.TextIOWrapper(buffered, encoding, "backslashreplace", line_buffering=by_lines)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise Termination


def _silence_libraries() -> None:
    """Discard what image libraries and solvers print on descriptor 2."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def ended(exit_code: int) -> int:
    """End the process after all exit functions. Python would destroy its objects one by one, which takes as long as
    many a solve, and wait for abandoned native work.
    """
    if os.environ.get("CERES_CAL_DEBUG"):  # a profiler needs a normal exit
        return exit_code
    native = sys.modules.get("ceres_cal.base.threads")
    if native is None or not native.is_busy():
        atexit._run_exitfuncs()
    sys.stdout.flush()
    lost = cast(_SafeStream, cast(io.BufferedWriter, sys.stdout.buffer).raw).lost
    if lost is not None and not isinstance(lost, BrokenPipeError):  # a closed pipe means that no more output is wanted
        print(f"ceres-cal: the answer is not on standard output: {lost.strerror}", file=sys.stderr)
    sys.stderr.flush()
    os._exit(exit_code)


def print_answer(answer: Document, *, as_json: bool, quiet: bool = False) -> None:
    """Print an answer; with --quiet only its one line."""
    if quiet and not as_json:
        print(answer.one_line)
    elif as_json:
        print(base.json_text(answer.data))
    else:
        text = answer.text()
        print(coloured(text) if in_colour(sys.stdout) else text)


# ---- the command that is typed --------------------------------------------------------------------------------------

_BEGINNINGS = {"", *(name.partition(" ")[0] for name in COMMANDS if " " in name)}
_FORESEEN = (CalibrationError, KeyboardInterrupt, MemoryError, OSError)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Args:
        arguments: by default those of the command line.

    Returns:
        0 success, 1 the answer is no or a part of it could not be made, 2 bad usage or input, 3 no usable solution, 130
            interrupted, 143 terminated.
        The code describes the work, whether or not its output could be written. Every failure is one line on standard
            error, with --json also an object on standard output; with CERES_CAL_DEBUG set an unexpected one is raised
            instead.
    """
    if arguments is not None:
        return _answer(list(arguments))
    as_a_program()
    return ended(_answer(sys.argv[1:]))


def _answer(arguments: list[str]) -> int:
    """Run one command; return its exit code in any case."""
    with noting():
        try:
            return _run(arguments)
        except SystemExit as done:  # quiet: argparse has printed its help
            return int(done.code or 0)
        except (Exception, KeyboardInterrupt) as error:  # reads: "ceres-cal: ..." on standard error
            if os.environ.get("CERES_CAL_DEBUG") and not isinstance(error, _FORESEEN):
                raise
            return _fail(*_words(error), "--json" in arguments)


def _words(error: BaseException) -> tuple[str, int]:
    """Return the message for an error, and the exit code."""
    interrupted = 130  # exit code that a shell reports for a program ended by SIGINT
    most_letters = 200  # largest length of an error that was not written for users
    if isinstance(error.__cause__, KeyboardInterrupt):  # an interrupted import raises an ImportError instead
        error = error.__cause__
    match error:
        case CalibrationError():
            return str(error), error.exit_code
        case KeyboardInterrupt():
            how, code = ("terminated", TERMINATED) if isinstance(error, Termination) else ("interrupted", interrupted)
            return f"{how}: {noted_words()}", code
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
    print(f"{_RED}{said}{_PLAIN}" if in_colour(sys.stderr) else said, file=sys.stderr)
    if as_json:
        import json

        print(json.dumps({"error": line, "exit_code": exit_code}), flush=True)
    return exit_code


def _run(arguments: list[str]) -> int:
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    beginning = " ".join(arguments[:-1])
    if arguments[-1:] in ([], ["-h"], ["--help"]) and beginning in _BEGINNINGS and beginning not in COMMANDS:
        print(_overview(beginning))
        return 0 if arguments else InputError.exit_code
    if "--version" in arguments:
        print(", ".join(f"{name} {version}" for name, version in calibration.package_versions().items()))
        return 0
    command, rest = chosen(arguments)
    options = command.parse(rest)
    answer = command.run(options)
    print_answer(answer, as_json=options.json, quiet=getattr(options, "quiet", False))
    return answer.exit_code


def chosen(arguments: list[str]) -> tuple[Command, list[str]]:
    """Return the command that is typed, and its arguments; InputError if there is no such command."""
    for words in (2, 1):
        command = COMMANDS.get(" ".join(arguments[:words]))
        if command is not None:
            return command, arguments[words:]
    if arguments[0] in _BEGINNINGS:
        below = [name for name in COMMANDS if name.startswith(f"{arguments[0]} ")]
        meant = did_you_mean(" ".join(arguments[:2]), below) if arguments[1:] else ""
        listed = f": one of {', '.join(below)}?"
        raise InputError(f"{arguments[0]} what{meant or listed}")
    typed = arguments[0] if arguments[0].startswith("-") else " ".join(arguments[:2])
    meant = did_you_mean(typed, COMMANDS) or did_you_mean(arguments[0], COMMANDS)
    if os.path.exists(arguments[0]):  # noqa: PTH110 which takes what is too long for a name, too
        meant = ": a command comes first, such as `ceres-cal run` before photographs"
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
