"""The constants that decide something: each exists, has a comment with its reason, and can be set for a measurement."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from constants import DECIDING, Constant, changes, measured, scaled

SRC = Path(__file__).parents[1] / "src/ceres_cal"
each_constant = pytest.mark.parametrize("constant", DECIDING, ids=str)


@cache
def parsed(module: str) -> tuple[str, list[ast.stmt]]:
    text = (SRC / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")
    return text, ast.parse(text).body


def assignment(module: str, name: str) -> tuple[list[str], int, ast.stmt | None]:
    """Lines of the module, number of the one that sets the name, and the statement after it."""
    text, body = parsed(module)
    for number, node in enumerate(body):
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
        if name in names:
            return text.splitlines(), node.lineno, body[number + 1] if number + 1 < len(body) else None
    pytest.fail(f"{module} has no {name}: bring DECIDING of scripts/constants.py up to date")


@each_constant
def test_it_is_a_number(constant: Constant) -> None:
    parts = constant.value if isinstance(constant.value, tuple) else (constant.value,)
    assert all(isinstance(part, int | float) and part > 0.0 for part in parts)


@each_constant
def test_its_reason_stands_beside_it(constant: Constant) -> None:
    if "." in constant.name:  # a default of a class, whose docstring explains it
        return
    lines, number, after = assignment(constant.module, constant.name)
    beside = "#" in lines[number - 1] or lines[number - 2].startswith("#")
    below = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str)
    assert beside or below, f"{constant}: say why this value, and what goes wrong above and below"


def test_every_constant_stands_once() -> None:
    names = [str(constant) for constant in DECIDING]
    assert len(names) == len(set(names))


def test_scaled() -> None:
    assert scaled(4.0, 0.5) == 2.0 and scaled(3, 0.5) == 2 and scaled(1, 0.5) == 1
    assert scaled(0.9, 2.0) == pytest.approx(18.0 / 19.0)  # 9 to 1 becomes 18 to 1
    assert scaled((0.45, 1.7), 2.0) == (0.9, 3.4)


def test_changes() -> None:
    assert changes({"found": "9", "wrong": "0"}, {"found": "9", "wrong": "0"}) == "nothing"
    assert changes({"found": "9", "wrong": "0"}, {"found": "7", "wrong": "0"}) == "found 9 -> 7"


def test_a_constant_is_set_where_it_is_read() -> None:
    """In its module, where it was imported, and as the default of a dataclass; in a new process."""
    code = (
        "from constants import Constant; from ceres_cal.problem.parameters import Options; "
        "import ceres_cal.effects.table.lens as lens_rows; "
        "Constant('problem.parameters', 'Options.reject_sigma', ()).set(7.0); "
        "Constant('effects.effect', 'SMALL', ()).set(0.8); "
        "print(Options().reject_sigma, Options().loss_scale, lens_rows.SMALL)"
    )
    folder = Path(__file__).parents[1] / "scripts"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=folder)
    assert done.stdout.split() == ["7.0", "2.5", "0.8"]


@pytest.mark.thorough
def test_figures_are_measured(tmp_path: Path) -> None:
    """If almost nothing counts as known, more directions are weak; an error is reported."""
    constant = Constant("posterior.uncertainty", "KNOWN", ("verdicts",))
    now, then = measured("verdicts", 1, tmp_path), measured("verdicts", 1, tmp_path, constant, 1e-6)
    assert "weak directions named, 1 deg" in changes(now, then)
    assert "error" in measured("verdicts", 1, tmp_path, constant, "nonsense")  # type: ignore[arg-type]
