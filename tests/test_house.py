"""The structure: imports go downwards only, heavy libraries are imported in few packages, and modules are small."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = "ceres_cal"
SRC = Path(__file__).parents[1] / "src"
MAX_LINES = 450

# Each module, or package with its contents, has one line here.
FLOORS = {
    "base": 0,
    "kernels": 1,
    "scene": 1,
    "observations": 2,
    "problem": 3,
    "effects": 4,
    "start": 4,
    "simulate": 4,
    "robust": 5,
    "posterior": 6,
    "calibration": 7,
    "moves": 8,
    "formats": 9,
    "diagnostics": 9,
    "detect": 10,
    "report": 11,
    "functions": 12,
    "cli": 13,
    "__main__": 14,
}

# Library: packages that may import it, at the top or inside a function.
DOORS = {
    "pyceres": {"problem"},
    "cv2": {"detect", "report", "formats", "scene"},  # scene: what the markers of a printed board look like
    "pycolmap": {"start", "formats"},
    "matplotlib": {"report", "base"},  # base: for plot() of public objects
    "google": {"formats"},  # protobuf
    "yaml": {"formats"},
    "distributed": {"cli"},
    "aiohttp": {"cli"},
    "scipy": set(),  # for the tests only
}


def dotted(path: Path) -> str:
    """src/ceres_cal/detect/boards.py -> ceres_cal.detect.boards"""
    parts = path.relative_to(SRC).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room(name: str) -> str:
    """ceres_cal.detect.boards -> detect: the names in FLOORS and DOORS"""
    return (name + ".").split(".")[1]


@cache
def imports(path: Path) -> tuple[tuple[int, str], ...]:
    """Line and absolute dotted name of everything a module imports, wherever in the file it does so."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[tuple[int, str]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = path.relative_to(SRC).parent.parts
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join((*above, node.module) if node.module else above)
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


MODULES = {dotted(path): path for path in sorted((SRC / PACKAGE).rglob("*.py"))}


def module_of(target: str) -> str | None:
    """ceres_cal.detect.boards.find -> ceres_cal.detect.boards; None for other packages, and for missing modules"""
    while target and target not in MODULES:
        target = target.rpartition(".")[0]
    return target or None


def test_imports_go_downwards() -> None:
    for name in MODULES.keys() - {PACKAGE}:
        require_downwards(name)


def require_downwards(name: str) -> None:
    floor = FLOORS.get(room(name))
    assert floor is not None, f"{name} has no floor: give it a line in FLOORS (design: floor 0 knows nobody)"
    stub = MODULES[name].with_suffix(".pyi")  # names that a package re-exports lazily
    for line, target in (*imports(MODULES[name]), *(imports(stub) if stub.exists() else ())):
        if target.split(".")[0] != PACKAGE:
            continue
        where, below = f"{name}, line {line}", FLOORS.get(room(target))
        assert below is not None, f"{where} imports {target}: import from the module that defines it, by its full name"
        assert below <= floor, (
            f"{where} (floor {floor}) imports {target} from floor {below}: move what is shared down, or hand it in"
        )


def test_no_cycles() -> None:
    graph = {name: {module_of(target) for _, target in imports(path)} - {None} for name, path in MODULES.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"imports run in a circle, {' <- '.join(error.args[1])}: move what both need into a module below")


def test_libraries_come_in_by_their_door() -> None:
    for name, (line, target) in ((name, one) for name, path in MODULES.items() for one in imports(path)):
        library = target.split(".")[0]
        assert room(name) in DOORS.get(library, {room(name)}), (
            f"{name}, line {line}, imports {library}, which only {sorted(DOORS[library]) or 'tests'} may: use those"
        )


def test_importing_the_package_is_light() -> None:
    code = f"import sys, {PACKAGE}; print(*sorted({set(DOORS)} & sys.modules.keys()))"
    heavy = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not heavy, f"import {PACKAGE} brings in {heavy}: import them, or the module that does, where they are used"


def test_no_module_hides_a_public_name() -> None:
    code = f"import {PACKAGE}; print(*{PACKAGE}.__all__)"
    names = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    hidden = {name for name in names if f"{PACKAGE}.{name}" in MODULES}
    assert not hidden, f"modules named like public functions take their place when imported: rename {hidden}"


def test_modules_stay_small() -> None:
    for name, path in MODULES.items():
        lines = len(path.read_text(encoding="utf-8").splitlines())
        assert lines <= MAX_LINES, f"{name} has {lines} lines, more than {MAX_LINES}: split off a part that has a name"


def test_class_names_are_nouns() -> None:
    """A participle does not say what it describes. "As built" and "linearised" are terms of the
    field (docs/design.md).
    """
    classes = [
        name
        for folder in (SRC / PACKAGE, *(SRC.parent / name for name in ("scripts", "tests")))
        for path in folder.rglob("*.py")
        for name in re.findall(r"^ *class (\w+)\b.*:$", path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    irregular = ("Built", "Found", "Kept", "Known", "Left", "Made", "Seen", "Shown", "Taken", "Told")
    named = [name for name in classes if name.endswith(("ed", *irregular))]
    assert sorted(named) == ["AsBuilt", "FieldAsBuilt", "Linearised"]
