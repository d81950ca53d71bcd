"""The command that the measuring scripts share."""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import run as front
from runner import Row, script

ROOT = Path(__file__).parents[1]


def even(runs: int) -> Iterator[Row]:
    yield Row("even", "twice", 2.0 * runs, most=20.0, note=f"{runs} runs")


def odd(runs: int) -> Iterator[Row]:
    yield Row("odd", "itself", runs, least=3.0)


def together(rows: Sequence[Row]) -> Iterator[Row]:
    yield Row("all", "number of figures", len(rows))
    yield Row("all", "still", len(rows))


def say(*arguments: object) -> int:
    given = [str(argument) for argument in arguments]
    return script({"even": even, "odd": odd}, "What.\nMore.", (7, "things"), 2, together)(given)


def test_verdicts() -> None:
    row = Row("case", "what", 1.06, 0.02, 0.95, 1.05)
    assert row.verdict == "open"
    assert replace(row, value=1.10).verdict == "no"
    assert replace(row, value=0.96).verdict == "yes"
    assert replace(row, least=-np.inf, most=np.inf).verdict == ""


def test_every_case_and_what_is_said_of_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "figures.json"
    assert say("--json", path) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["even", "even:", "odd", "odd:", "all", "all"]
    assert lines[0].split() == ["even", "twice", "14", "to", "20", "yes", "7", "runs"]
    written = json.loads(path.read_text(encoding="utf-8"))
    assert [row["value"] for row in written] == [14.0, 7, 2, 2]
    assert "least" not in written[0] and written[0]["most"] == 20.0  # JSON knows no infinity


def test_the_exit_code_tells_of_what_is_missed(capsys: pytest.CaptureFixture[str]) -> None:
    assert say("--runs", 2) == 1
    assert say("--runs", 2, "--case", "even") == 0
    assert "odd" not in capsys.readouterr().out.rpartition("even")[2]


@pytest.mark.parametrize("wrong", [["--runs", "1"], ["--case", "none"], ["--run", "3"]])
def test_wrong_usage(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        say(*wrong)
    assert stopped.value.code == 2 and "error: " in capsys.readouterr().err


def test_figures_alone_for_other_programs(capsys: pytest.CaptureFixture[str]) -> None:
    """--json without a file prints the figures instead of the table."""
    assert say("--case", "even", "--case", "odd", "--json") == 0
    assert [row["value"] for row in json.loads(capsys.readouterr().out)] == [14.0, 7, 2, 2]


def test_every_script_is_found_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    """Names are unique, each has a line in the list, and scripts that documents name exist."""
    assert front.main([]) == 0
    listed = capsys.readouterr().out
    every = [path.stem for path in front.HERE.glob("*/*.py") if "main = script(" in path.read_text(encoding="utf-8")]
    assert len(set(every)) == len(every) > 10 and set(every) <= set(front.scripts())
    assert all(f" {name} " in listed for name in front.scripts())
    documents = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "data/README.md", ROOT / "scripts/demo"]
    text = "".join(path.read_text(encoding="utf-8") for path in documents)
    named = set(re.findall(r"run[.]py ([a-z]\w*)", text))
    assert len(named) > 10 and named <= set(front.scripts())
    assert front.main(["nothing"]) == 2 and "lists them" in capsys.readouterr().err


def test_a_script_that_takes_paths_alone_explains_itself(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("built_in_scenes", "make_honest_picture", "make_picture"):
        assert front.main([name, "--help"]) == 0 and f"run.py {name}" in capsys.readouterr().out
    assert not [*tmp_path.iterdir()]
