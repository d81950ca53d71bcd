"""Hook of mkdocs for the book: adds the help of every command, as the command prints it (mkdocs.yml, hooks)."""

from __future__ import annotations

import os
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

WIDTH = 96


def help_of(name: str) -> str:
    """Output of `ceres-cal NAME --help` in lines of WIDTH letters."""
    from ceres_cal.cli import main

    os.environ["COLUMNS"] = str(WIDTH)
    said = StringIO()
    with redirect_stdout(said):
        main([*name.split(), "--help"])
    return said.getvalue().rstrip()


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by mkdocs for each page: the page of commands gets a section for each of them."""
    if page.file.src_uri != "commands.md":
        return markdown
    from ceres_cal.cli.command import COMMANDS

    sections = [f"## {name}\n\n```text\n{help_of(name)}\n```" for name in COMMANDS]
    return "\n\n".join([markdown.rstrip(), *sections])
