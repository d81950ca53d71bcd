"""`ceres-cal completion`: the script with which a shell completes commands, options and files."""

from __future__ import annotations

import argparse
from argparse import ArgumentParser
from collections.abc import Mapping
from typing import Literal

from ceres_cal.base.errors import InputError
from ceres_cal.cli.command import COMMANDS, Command, Parser, argument, command
from ceres_cal.report.document import Document, Section

_FILE = {"bash": "_shtab_compgen_files", "zsh": "_files", "tcsh": "f"}
_EXAMPLES = ("bash > ~/.local/share/bash-completion/completions/ceres-cal", "zsh > ~/.zfunc/_ceres-cal")


@command("completion", "what a shell needs to complete commands, options and files", *_EXAMPLES)
def _run(
    shell: Literal["bash", "zsh", "tcsh"] = argument("SHELL", "whose; what is printed goes into a file that it reads"),
) -> Document:
    try:
        import shtab
    except ImportError:
        raise InputError("completion needs shtab: pip install 'ceres-cal[completion]'") from None
    script = shtab.complete(whole_parser(COMMANDS), shell=shell)
    return Document((Section("", [script], {"shell": shell, "script": script}),))


def whole_parser(commands: Mapping[str, Command]) -> ArgumentParser:
    """Make one parser of all commands, with those of two words as subcommands of the first. Values without choices
    complete as files.
    """
    root = Parser(prog="ceres-cal", description="Calibrate an overhead camera.")
    below = {"": root.add_subparsers()}
    for name in sorted(commands):
        first, _, second = name.partition(" ")
        if second and first not in below:
            above = below[""].choices.get(first) or below[""].add_parser(first, help=f"{first} ...")
            below[first] = above.add_subparsers()
        command = commands[name]
        parser = below[first if second else ""].add_parser(second or first, help=command.summary, **command.about)
        command.fill(parser)
        for action in parser._actions:
            if action.nargs != 0 and action.choices is None and not isinstance(action, argparse._SubParsersAction):
                action.complete = _FILE  # type: ignore[attr-defined]
    return root
