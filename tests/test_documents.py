"""The commands in the documents work in their order, and print the output that is shown."""

import re
import shlex
from pathlib import Path

import pytest
from data.documents import DOCUMENTS, Step, agree, differences, rewritten, run, steps_of
from thorough import partly

from ceres_cal import InputError
from ceres_cal.cli.terminal import chosen
from data import documents

CODE = re.compile(r"^```(?:console|text)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# The others take a minute together, and repeat many commands.
EACH_TIME = [path for path in DOCUMENTS if path.stem in ("README", "scale")]
INLINE = re.compile(r"`(ceres-cal [^`]+)`")


def typed(text: str) -> list[list[str]]:
    """Every complete call of ceres-cal in a document, as the program gets its arguments."""
    lines = [line for block in CODE.findall(text) for line in block.replace("\\\n", " ").splitlines()]
    calls = [call for line in lines for call in re.split(r"\|\|?|&&|;", line) if "ceres-cal " in call]
    calls = [call[call.index("ceres-cal ") :] for call in calls if re.match(r"\s*(\$ )?ceres-cal ", call)]
    return [shlex.split(call, comments=True)[1:] for call in (*calls, *INLINE.findall(text))]


@pytest.mark.parametrize("path", partly(DOCUMENTS, EACH_TIME), ids=lambda path: path.name)
def test_every_command_works_and_prints_what_is_said(path: Path) -> None:
    found = differences(path)
    name = path.relative_to(documents.ROOT)
    assert not found, "\n".join([*found, f"if that is right: python scripts/run.py documents --write {name}"])


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_every_command_that_is_named_is_one(path: Path) -> None:
    for arguments in typed(path.read_text(encoding="utf-8")):
        if not {"COMMAND", "...", "--help", "--version"} & set(arguments):
            assert complaint(arguments) in ("", "required"), arguments


def complaint(arguments: list[str]) -> str:
    """An empty text for calls that can be run; "required" for commands that are only named, perhaps with an option."""
    command, rest = chosen(arguments)
    try:
        command.parse(rest)
    except InputError as error:
        return "required" if "are required" in str(error) else str(error)
    return ""


@pytest.mark.parametrize(
    "said, now, same",
    [
        ("phi 868.9 ± 1.5 px", "phi  869.0 ± 1.5 px", True),  # one unit of the last digit
        ("phi 868.9 ± 1.5 px", "phi 869.1 ± 1.5 px", False),
        ("103 of 2271 taken out", "104 of 2271 taken out", False),  # whole numbers
        ("a2 -4.96e-05 ± 2.2e-06", "a2 -4.97e-05 ± 2.2e-06", True),
        ("a2 -4.96e-05 ± 2.2e-06", "a2 4.96e-05 ± 2.2e-06", False),
        ("phi is known", "phi is weak", False),
        ("0001.jpg: 3.5", "0002.jpg: 3.5", False),  # a name holds no number
    ],
)
def test_lines_agree_to_the_last_digit(said: str, now: str, same: bool) -> None:
    assert agree(said, now) is same


def test_a_document_is_run_and_put_right(tmp_path: Path) -> None:
    text = "Say\n\n```console\n$ x=3\n$ echo $x \\\n    more\n2 more\n```\n\n```python\nprint('unseen')\n```\n"
    assert steps_of(text) == [Step("x=3"), Step("echo $x \\\n    more", ("2 more",)), Step("print('unseen')\n")]
    runs = run(text.replace("```python", "```"), tmp_path)
    assert [each.differences for each in runs] == [[], ["  document: 2 more\n  printed:  3 more"]]
    assert rewritten(text.replace("```python", "```"), runs) == text.replace("```python", "```").replace("2 m", "3 m")
    (failed,) = run("```console\n$ false\n$ echo never\n```\n", tmp_path)
    assert failed.differences == ["exit code 1: "]


def test_python_in_a_document_is_run(tmp_path: Path) -> None:
    documents.prepare(tmp_path)
    text = "```console\n$ source .venv/bin/activate\n```\n```python\nx = 1\nopen('made', 'w').write(str(x))\n```\n"
    assert [each.exit_code for each in run(text, tmp_path)] == [0, 0]
    assert (tmp_path / "made").read_text() == "1"
