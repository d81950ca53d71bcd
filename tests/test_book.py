"""The book builds without a warning, every link in it leads somewhere, and every public name is in its reference."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from chromium import browser

import ceres_cal
from ceres_cal.cli.command import COMMANDS

ROOT = Path(__file__).resolve().parents[1]


class Page(HTMLParser):
    """The links of a page, and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.names: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {key: value for key, value in attrs if value}
        self.names |= {given[key] for key in ("id", "name") if key in given}
        self.links += [given[key] for key in ("href", "src") if key in given]


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Page]:
    """The pages of the book, built as `mkdocs build --strict` builds it."""
    pytest.importorskip("mkdocs", reason="pip install 'ceres-cal[docs]'")
    site = tmp_path_factory.mktemp("book") / "site"
    path = os.pathsep.join([str(ROOT / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": path}
    call = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]  # --quiet hides warnings
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return {page: Page(page) for page in sorted(site.rglob("*.html"))}


def targets(pages: dict[Path, Page]) -> Iterator[tuple[Path, str, Path, str]]:
    """Page, link, and the file and name that it leads to; links to the network are left out."""
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if not parts.scheme and not parts.netloc:
                there = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
                yield path, link, there, unquote(parts.fragment)


def test_every_link_leads_somewhere(pages: dict[Path, Page]) -> None:
    found = list(targets(pages))
    assert len(found) > 500
    missing = [
        f"{path.name}: {link}"
        for path, link, there, name in found
        if path.name != "404.html"  # its links are those of the root of a server
        and (not there.exists() or (name and there in pages and name not in pages[there].names))
    ]
    assert not missing


def test_nothing_is_fetched_from_a_network(pages: dict[Path, Page]) -> None:
    fetched = re.compile(r'<(?:link|script|img)[^>]*(?:href|src)="https?:')
    assert [path.name for path in pages if fetched.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("width", [390, 1400])
def test_the_search_works_from_files(pages: dict[Path, Page], width: int) -> None:
    (index,) = (path for path in pages if path.name == "index.html")
    with browser() as window:
        window.open(index, width)
        window.wait_for("document.querySelector('[data-md-component=search-query]')", 20.0)
        window.run("document.querySelector('#__search').click()")
        type_it = "const q = document.querySelector('[data-md-component=search-query]'); q.focus(); q.value = 'height';"
        window.run(f"(() => {{{type_it} q.dispatchEvent(new KeyboardEvent('keyup', {{key: 't'}}))}})()")
        window.wait_for("document.querySelectorAll('.md-search-result__item').length > 3", 30.0)
        assert all(url.startswith("file:") for url in window.requests)


def test_every_public_name_is_in_the_reference(pages: dict[Path, Page]) -> None:
    (reference,) = (page for path, page in pages.items() if path.name == "api.html")
    named = {re.sub(r"^ceres_cal\.(?:\w+\.)*", "", name) for name in reference.names if name.startswith("ceres_cal.")}
    assert set(ceres_cal.__all__) <= named


def test_every_command_is_in_the_reference(pages: dict[Path, Page]) -> None:
    (path,) = (path for path in pages if path.name == "commands.html")
    text = path.read_text(encoding="utf-8")
    assert [name for name in COMMANDS if f"usage: ceres-cal {name} " not in text] == []
