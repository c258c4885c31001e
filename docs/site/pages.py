"""Hook of mkdocs: what the site makes of pages that are written for a code host first.

The marks of measured numbers go. A link that leaves docs/ becomes the path of its file, because
the site holds no sources; a file that is not there is a warning, which ends a strict build.
"""

import logging
import re
from pathlib import Path
from typing import Any, Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.pages import Page

_LINK: Final = re.compile(r"\[([^\[\]]+)\]\((\.\./[^)\s#]*)(?:#[^)\s]*)?\)")
_MARK: Final = re.compile(r"<!--=.*?-->")

_log: Final = logging.getLogger("mkdocs.hooks.pages")


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, **_: Any) -> str:
    """The page without marks, and without links to what is not part of the site."""
    docs = Path(config.docs_dir)
    folder = (docs / page.file.src_uri).parent

    def inside(match: re.Match[str]) -> str:
        target = (folder / match[2]).resolve()
        if target.is_relative_to(docs):
            return match[0]
        if not target.exists():
            _log.warning("%s links to %s, which is not there", page.file.src_uri, match[2])
        path, text = str(target.relative_to(docs.parent)), match[1].strip("`")
        return f"`{path}`" if path.endswith(text) else f"{match[1]} (`{path}`)"

    return _LINK.sub(inside, _MARK.sub("", markdown))
