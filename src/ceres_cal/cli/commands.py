"""Every command by its name. Its module is imported when it is asked for: a start with all of them takes longer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module

from ceres_cal.cli.command import Command

_MODULES = {
    "run": "run",
    "detect board": "detect",
    "detect rings": "detect_rings",
    "detect field": "detect_field",
    "join": "join",
    "calibrate": "calibrate",
    "diagnose": "diagnose",
    "advise": "advise",
    "refit": "refit",
    "check": "check",
    "score": "score",
    "compare": "compare",
    "audit": "audit",
    "batch": "batch",
    "locate": "locate",
    "project": "locate",
    "undistort": "undistort",
    "export": "export",
    "export-table": "export",
    "import": "foreign",
    "publish": "foreign",
    "listen": "foreign",
    "targets import": "foreign",
    "simulate": "simulate",
    "targets": "targets",
    "targets print": "targets",
    "completion": "completion",
}


class _Commands(Mapping[str, Command]):
    def __getitem__(self, name: str) -> Command:
        module = import_module(f"ceres_cal.cli.{_MODULES[name]}")
        return next(one for one in vars(module).values() if isinstance(one, Command) and one.name == name)

    def __contains__(self, name: object) -> bool:
        return name in _MODULES

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


COMMANDS: Mapping[str, Command] = _Commands()
