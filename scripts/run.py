"""Runs a script of the subfolders by its name: python scripts/run.py NAME [--help]; without a name it lists them."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
_MAIN = re.compile(r"^(?:def main\(|main = )", re.MULTILINE)


def scripts() -> dict[str, Path]:
    """The scripts that have a `main`, by name."""
    return {path.stem: path for path in sorted(HERE.glob("*/*.py")) if _MAIN.search(path.read_text(encoding="utf-8"))}


def listed() -> str:
    """A line for each script, by folder."""
    lines = []
    for name, path in scripts().items():
        first = path.read_text(encoding="utf-8").partition("\n")[0].strip('"')
        lines.append(f"{path.parent.name:11}{name:22}{re.sub(r': (python|[A-Z-]).*', '', first)}")
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"{__doc__}\n{listed()}")
        return 0
    name, *given = arguments
    path = scripts().get(name)
    if path is None:
        print(f"run.py: there is no script {name!r}: `python scripts/run.py` lists them", file=sys.stderr)
        return 2
    sys.argv = [f"run.py {name}", *given]  # the program's name in its help
    script = importlib.import_module(f"{path.parent.name}.{name}")
    if {"-h", "--help"} & {*given} and not hasattr(script, "parser") and not hasattr(script, "argparse"):
        print(script.__doc__)  # it has no parser, since it takes only paths
        return 0
    code: int = script.main(given)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
