"""Runs the commands in documents and compares their output: python scripts/run.py documents [--write] [FILE...]

All commands of a document (```console, after "$ ") and its Python (```python) run in order in one shell, in a copy of
the sample data and scripts with a .venv that uses this interpreter. A command must end with exit code 0. The text below
it, if any, is compared with its output: words and whole numbers exactly (except numbers of iterations), other numbers
to one unit of their last digit, since two machines may round differently. --write replaces the text by the output.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COPIED = ("data", "examples", "scripts", "pyproject.toml", "CMakeLists.txt", "src/ceres_cal/kernels/core")
_BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
_EFFORT = re.compile(r"\d+ (?=(solve|iteration))")
_MARK = "=== end of command"


@dataclass(frozen=True)
class Step:
    """One command, or one piece of Python, of a document; `shown` is the text below it."""

    command: str
    shown: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        return "\n".join((f"$ {self.command}", *self.shown))


@dataclass(frozen=True)
class Run:
    """The output of a step, and its exit code."""

    step: Step
    printed: tuple[str, ...]
    exit_code: int
    errors: str

    @property
    def differences(self) -> list[str]:
        """Differences between the document and the output, one line each; none where the document is right."""
        if self.exit_code:
            return [f"exit code {self.exit_code}: {self.errors.strip()}"]
        if not self.step.shown:
            return []
        pairs = zip_longest(self.step.shown, self.printed, fillvalue="")
        return [f"  document: {said}\n  printed:  {now}" for said, now in pairs if not agree(said, now)]


def agree(said: str, now: str) -> bool:
    """Whether two lines agree, as described above."""
    said, now = (_EFFORT.sub("", line) for line in (said, now))  # the number of iterations may differ
    if " ".join(_NUMBER.sub("#", said).split()) != " ".join(_NUMBER.sub("#", now).split()):
        return False
    pairs = zip(_NUMBER.findall(said), _NUMBER.findall(now), strict=True)
    return all(abs(float(a) - float(b)) <= 1.01 * max(_unit(a), _unit(b)) for a, b in pairs)


def _unit(number: str) -> float:
    """One unit of a number's last digit; 0 for whole numbers."""
    digits, _, power = number.partition("e")
    places = len(digits.partition(".")[2])
    return 10.0 ** (int(power or 0) - places) if places or power else 0.0


# ---- documents ------------------------------------------------------------------------------------------------------


def steps_of(text: str) -> list[Step]:
    """All steps of a document, in order."""
    return [step for kind, body in _BLOCK.findall(text) for step in _steps_in(kind, body)]


def _steps_in(kind: str, body: str) -> list[Step]:
    if kind == "python":
        return [Step(body)]
    found: list[Step] = []
    for line in body.splitlines():
        if line.startswith("$ "):
            found.append(Step(line[2:]))
        elif found and found[-1].command.endswith("\\"):
            found[-1] = Step(f"{found[-1].command}\n{line}")
        else:
            found[-1] = Step(found[-1].command, (*found[-1].shown, line))
    return found


def rewritten(text: str, runs: Sequence[Run]) -> str:
    """The document with the new output below each command that shows an output."""
    rest = iter(runs)

    def block(found: re.Match[str]) -> str:
        steps = _steps_in(*found.groups())
        ran = [next(rest) for _ in steps]
        if found[1] == "python":
            return found[0]
        lines = [Step(run.step.command, run.printed if run.step.shown else ()).text for run in ran]
        return "\n".join(("```console", *lines, "```"))

    return _BLOCK.sub(block, text)


# ---- running --------------------------------------------------------------------------------------------------------


def run(text: str, folder: Path) -> list[Run]:
    """Run all steps of a document in a folder made by `prepare`; stops at the first command that fails."""
    steps = steps_of(text)
    script = [f"exec 2>{folder}/errors"]
    for number, step in enumerate(steps):
        if "\n" in step.command and not step.command.partition("\n")[0].endswith("\\"):
            (folder / f"{number}.py").write_text(step.command, encoding="utf-8")
            script.append(f"python {number}.py")
        else:
            script.append(step.command)
        script.append(f'code=$?; echo; echo "{_MARK} $code"; [ $code = 0 ] || exit')
    done = subprocess.run(
        ["bash", "-c", "\n".join(script)], cwd=folder, env=_environment(folder), stdout=subprocess.PIPE, text=True,
        check=False,
    )  # fmt: skip
    errors = (folder / "errors").read_text(encoding="utf-8")
    parts = re.findall(rf"(.*?)\n{_MARK} (\d+)\n", done.stdout, re.DOTALL)
    return [
        Run(step, tuple(printed.rstrip("\n").splitlines()), int(code), errors)
        for step, (printed, code) in zip(steps, parts, strict=False)
    ]


def _environment(folder: Path) -> dict[str, str]:
    """A user's environment: `ceres-cal` is found after .venv is activated."""
    import os

    return {**os.environ, "PYTHONPATH": str(ROOT / "src"), "COLUMNS": "100"}


def prepare(folder: Path) -> Path:
    """A copy of a fresh clone, with a .venv as `scripts/setup` makes it."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif (ROOT / name).exists():
            shutil.copy(ROOT / name, folder / name)
    bin_folder = folder / ".venv/bin"
    bin_folder.mkdir(parents=True)
    program = "import sys; from ceres_cal.cli import main; sys.exit(main())"
    for name, call in (("python", '"$@"'), ("ceres-cal", f"-c '{program}' \"$@\"")):
        (bin_folder / name).write_text(f'#!/usr/bin/env bash\nexec "{sys.executable}" {call}\n', encoding="utf-8")
        (bin_folder / name).chmod(0o755)
    (bin_folder / "activate").write_text(f'export PATH="{bin_folder}:$PATH"\n', encoding="utf-8")
    stamp = subprocess.run([folder / "scripts/setup", "--wanted"], stdout=subprocess.PIPE, check=True).stdout
    (folder / ".venv/installed").write_bytes(stamp)
    return folder


def differences(path: Path, *, write: bool = False) -> list[str]:
    """Differences between a document and the output of its commands; with `write` the document is corrected."""
    text = path.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        runs = run(text, prepare(Path(folder)))
    failed = [each for each in runs if each.exit_code]
    if write and not failed:
        path.write_text(rewritten(text, runs), encoding="utf-8")
        return []
    return [f"{path.name}: $ {each.step.command}\n{line}" for each in runs for line in each.differences]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("files", nargs="*", type=Path, default=DOCUMENTS, help="default: README and docs")
    parser.add_argument("--write", action="store_true", help="put what is printed now into the document")
    given = parser.parse_args(arguments)
    found = [line for path in given.files for line in differences(path, write=given.write)]
    print("\n".join(found) if found else "every command runs, and prints what is said")
    return 1 if found else 0
