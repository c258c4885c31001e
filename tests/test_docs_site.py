"""The documentation's site: its start page's program runs, its reference is whole, and its pages
lead to each other and load nothing from elsewhere. What is said of a version is of this one."""

import re
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from textwrap import indent
from urllib.parse import unquote, urlsplit

import pytest
import yaml

import bayesrace
from tests.programs import ROOT

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
PROGRAM = "".join(
    re.findall(r"^```python\n(.*?)^```$", (DOCS / "index.md").read_text(), re.DOTALL | re.MULTILINE)
)


def test_the_start_page_reaches_a_learned_lap_in_ten_lines(tmp_path: Path) -> None:
    assert len([line for line in PROGRAM.splitlines() if line]) == 10
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"\(\) \(\d+\.\d+, \d+\.\d+\)\n", done.stdout), "no lap, then two"
    assert (tmp_path / "learned.png").read_bytes().startswith(b"\x89PNG")


def test_the_package_begins_with_the_same_program() -> None:
    assert indent(PROGRAM, "    ") in (bayesrace.__doc__ or "")


def test_each_public_name_is_in_the_reference_once() -> None:
    pages = "\n".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    named = re.findall(r"^::: bayesrace\.(\w+)$", pages, re.MULTILINE)
    assert sorted(named) == sorted([*bayesrace.__all__, "gym", "testing"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_lists_are_lists_in_the_site_too(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    joined = re.findall(r"^(?![ #>|*-]|\d+\. ).+\n(?:[*-]|\d+\.) .*", text, re.MULTILINE)
    beside = [one for one in joined if not _continues_item(text, one)]
    assert not beside, "put an empty line before the list"


def _continues_item(text: str, found: str) -> bool:
    """Whether the line before the list is itself the rest of an item."""
    block = text[: text.index(found)].rsplit("\n\n", 1)[-1]
    return re.match(r"[*-] |\d+\. ", block) is not None


class _Page(HTMLParser):
    """Anchors of a page, links to follow, and what it loads."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = {name: value or "" for name, value in attrs}
        self.anchors |= {known[name] for name in ("id", "name") if name in known}
        if tag == "a" and "href" in known:
            self.links.append(known["href"])
        elif tag == "link" and "href" in known:
            self.loaded.append(known["href"])
        elif "src" in known:
            self.loaded.append(known["src"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, _Page]:
    """The pages of a strict build."""
    folder = tmp_path_factory.mktemp("site").resolve()
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    found = {path: _Page(path.read_text()) for path in folder.rglob("*.html")}
    del found[folder / "404.html"]  # its links are of no folder
    return found


@pytest.mark.check
def test_all_pages_are_reached_and_no_link_is_broken(site: dict[Path, _Page]) -> None:
    start = min(site, key=lambda path: len(path.parts))
    reached, waiting = {start.with_name("index.html")}, [start.with_name("index.html")]
    while waiting:
        here = waiting.pop()
        for link in site[here].links:
            parts = urlsplit(link)
            if parts.scheme:
                continue
            there = (here.parent / unquote(parts.path)).resolve() if parts.path else here
            assert there.is_file(), f"{here} links to {link}"
            if there in site:
                anchor = unquote(parts.fragment)
                assert not anchor or anchor in site[there].anchors, f"{here} links to {link}"
                if there not in reached:
                    reached.add(there)
                    waiting.append(there)
    assert reached == set(site)


@pytest.mark.check
def test_pages_load_only_what_the_site_holds(site: dict[Path, _Page]) -> None:
    for path, page in site.items():
        for loaded in page.loaded:
            assert (path.parent / urlsplit(loaded).path).is_file(), f"{path} loads {loaded}"


@pytest.mark.check
def test_docstrings_are_rendered(site: dict[Path, _Page]) -> None:
    pages = [path for path in site if path.parent.name == "reference"]
    for path in pages:
        assert not re.search(r":(class|func|meth|attr|data|mod):", path.read_text()), path
    (page,) = (path for path in pages if path.name == "controller.html")
    assert "<code>step_s</code></a>" in page.read_text()  # :attr:`step_s` in Controller.step


def test_what_is_cited_and_supported_is_this_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()
    assert cited["version"] == version
    assert f"| {version} and the main branch | yes |" in (ROOT / "SECURITY.md").read_text()
