"""The table of outcomes: figures read from commands, and the differences that it marks."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from outcomes import COMMANDS, Figure, load, main, save

ODD = """odd scenes: 4 scenes, 1 refused
                                  scenes  refused  known > 5 sd  places > 2.5
  few points, radial                                  3        1        0        2
  one curve, brown                                    1        0        1        0
  few points / radial / 0: 5.6 sd (phi), 3.00 radii
"""
ALARMS = """field alone                                50 scenes    1 false alarms  yes outlier 1
line 12 mm aside                            10 scenes  named in 9,   2 false alarms  no  bow 2
all clean, at most 1 % by design           50 scenes    1 false alarms  yes 2.00 %, 15 s
"""
ROWS = [
    {"case": "a", "what": "share", "value": 0.94, "error": 0.03, "verdict": "yes", "least": 0.93, "most": 0.97},
    {"case": "b", "what": "share", "value": 0.96, "error": 0.04, "verdict": "no", "least": 0.97, "most": 0.97},
    {"case": "a", "what": "far", "value": 2, "error": 0.0, "verdict": "no", "most": 0.0},
    {"case": "b", "what": "far", "value": 1, "error": 0.0, "verdict": "no", "most": 0.0},
]


def read(command: str, text: str) -> dict[str, Figure]:
    return {figure.name: figure for figure in COMMANDS[command].parse(command, text)}


def test_counts_of_odd_scenes_and_false_alarms() -> None:
    odd = read("odd_scenes", ODD)
    assert [odd[name].value for name in ("scenes", "refused", "known numbers over 5 sd off")] == [4, 1, 1]
    assert odd["places over 2.5 radii off"] == Figure("odd_scenes", "places over 2.5 radii off", 2, 2**0.5, "yes")
    assert odd["few points, radial: places > 2.5"].value == 2 and not odd["few points, radial: places > 2.5"].key
    alarms = read("false_alarms", ALARMS)
    assert alarms["faults named, share"].value == 0.9 and alarms["false alarms beside faults"].value == 2
    assert alarms["all clean, at most 1 % by design: false alarms"].key
    with pytest.raises(ValueError, match="no table"):
        read("odd_scenes", "Traceback")


def test_rows_are_summed_up_by_what_they_say() -> None:
    found = read("intervals", json.dumps(ROWS))
    assert found["share, mean"].value == pytest.approx(0.95) and found["share, mean"].error == pytest.approx(0.025)
    assert found["far, in all"].value == 3 and found["far, in all"].verdict == "no"
    assert found["figures missed"].value == 3 and not found["a: far"].key


def test_what_differs_is_marked() -> None:
    old = Figure("c", "n", 1.0, 0.1, "yes")
    assert not replace(old, value=1.28).differs(old)  # .283 is two standard errors of the difference
    assert replace(old, value=1.29).differs(old) == "higher"
    assert replace(old, verdict="no").differs(old) == "missed now"
    assert replace(old, value=float("nan")).differs(old) == "other"
    seconds = Figure("c", "s", 1.0)
    assert not replace(seconds, value=1.05).differs(seconds) and replace(seconds, value=0.9).differs(seconds) == "lower"


def test_a_table_is_stored_and_compared_with_its_own_kind(tmp_path: Path) -> None:
    path, setting = tmp_path / "table.json", {"quick": False, "share": 1.0}
    figures = [Figure("c", "n", 1.0, 0.1, "yes")]
    save(path, "", setting, figures)
    assert list(load(path, setting).values()) == figures
    with pytest.raises(SystemExit, match="give the same --quick and --share"):
        load(path, {"quick": True, "share": 1.0})


def test_another_checkout_is_measured_with_its_own_scripts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Anywhere below scripts/; a script without figures is reported, and changes the exit code."""
    (tmp_path / "scripts" / "accuracy").mkdir(parents=True)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    script = tmp_path / "scripts" / "accuracy" / "odd_scenes.py"
    runs = "import runpy, sys; runpy.run_path(f'{sys.path[0]}/accuracy/{sys.argv[1]}.py')"
    (tmp_path / "scripts" / "run.py").write_text(runs)
    script.write_text(f"print({ODD!r})")
    stored = tmp_path / "table.json"
    asked = ["--quick", "--checkout", str(tmp_path), "--only", "odd_scenes"]
    assert main([*asked, "-o", str(stored)]) == 0
    assert main([*asked, "--against", str(stored)]) == 0
    script.write_text(f"print({ODD.replace('  1        0        2', '  1        0        3')!r})")
    assert main([*asked, "--against", str(stored)]) == 1  # limit: 2
    assert "missed now" in capsys.readouterr().out
    script.write_text("raise SystemExit(3)")
    assert main(asked) == 1
    assert "exit code 3" in capsys.readouterr().out
