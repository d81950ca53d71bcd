"""References are valid: sections of the design, headings, files and links named in code and documents."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from ceres_cal.observations import Observations

ROOT = Path(__file__).parents[1]
CODE = sorted(path for folder in ("src", "tests", "scripts") for path in (ROOT / folder).rglob("*.py"))
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
ROOMS = sorted(path.name for path in (ROOT / "src/ceres_cal").iterdir() if path.is_dir() and path.name[0] != "_")

DESIGN = re.compile(r"[Dd]esign(?:,\s+|,?\s+sections?\s+)(\d+(?:(?:,|\s+and)\s+\d+)*)")
FILE = re.compile(r"\b((?:scripts|tests|docs|data|examples)/[\w.*-]+(?:/[\w.*-]+)*)")
IN_ROOM = re.compile(rf"`((?:{'|'.join(ROOMS)})/[\w/.-]*)`")
MODULE = re.compile(r"`(\w+\.py)`")
LINK = re.compile(r"\]\(([^)\s]*)\)")

each_document = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)


def headings(path: Path) -> list[str]:
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"^#+ (.+)$", text, re.MULTILINE)


def anchor(heading: str) -> str:
    """The anchor that GitHub makes."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def cited(pattern: re.Pattern[str], paths: list[Path]) -> Iterator[tuple[str, str]]:
    """Places of citations, and what they cite."""
    for path in paths:
        text = path.read_text(encoding="utf-8")
        for found in pattern.finditer(text):
            yield f"{path.relative_to(ROOT)}, line {text.count(chr(10), 0, found.start()) + 1}", found[1]


def test_sections_of_the_design() -> None:
    """Cited as "design, section 6" or "design, 5 and 6"."""
    sections = {heading.partition(".")[0] for heading in headings(ROOT / "docs/design.md")}
    citations = [
        (where, number)
        for where, numbers in cited(DESIGN, [*CODE, *DOCUMENTS])
        for number in re.findall(r"\d+", numbers)
    ]
    assert len(citations) > 20
    missing = [f"{where}: {number}" for where, number in citations if number not in sections]
    assert not missing, f"docs/design.md has no such section: {missing}"


def test_files() -> None:
    """Scripts, tests, documents and sample data that are named with their folder."""
    missing = [
        f"{where}: {name}" for where, name in cited(FILE, [*CODE, *DOCUMENTS]) if not any(ROOT.glob(name.rstrip(".")))
    ]
    assert not missing, f"not in the repository: {missing}"


@each_document
def test_modules(path: Path) -> None:
    """`room/module.py` must exist below the package, `module.py` anywhere in it or at the top."""
    package = ROOT / "src/ceres_cal"
    missing = [f"{where}: {name}" for where, name in cited(IN_ROOM, [path]) if not (package / name).exists()]
    names = {module.name for module in CODE}
    missing += [f"{where}: {name}" for where, name in cited(MODULE, [path]) if name not in names]
    assert not missing, f"no such room or module: {missing}"


@each_document
def test_links(path: Path) -> None:
    for where, target in cited(LINK, [path]):
        name, _, section = target.partition("#")
        if name.startswith(("http:", "https:", "mailto:")):
            continue
        there = path.parent / name if name else path
        assert there.exists(), f"{where}: {target} is not there"
        assert not section or section in map(anchor, headings(there)), f"{where}: {target}: no such heading"


def test_the_file_of_the_design_loads(tmp_path: Path) -> None:
    text = (ROOT / "docs/files.md").read_text(encoding="utf-8")
    path = tmp_path / "observations.json"
    path.write_text(text.partition("```json\n")[2].partition("```")[0], encoding="utf-8")
    observations = Observations.load(path)
    assert len(observations.points) == 3 and len(observations.curves) == 2
