"""What the site changes in the pages: links to files that it leaves out become words, or go."""

from __future__ import annotations

import re
from typing import Any

BARE = re.compile(
    r"\s*\(\[(?:entry|figures|why)\]\((?:\.\./|decisions\.md)[^)\s]*\)\)"
    r"|,\s*\[(?:entry|figures|why)\]\((?:\.\./|decisions\.md)[^)\s]*\)"
)
"""A link to such a file whose word says nothing by itself."""
OUTSIDE = re.compile(r"\[((?:[^\[\]]|\[[^\]]*\])+)\]\((\.\./|decisions\.md)([^)\s]*)\)")


def on_page_markdown(markdown: str, config: Any, **_: Any) -> str:
    """The page with links to the repository's files.

    Without the repository's address a link becomes its words with the file's name, and one that has
    only a word like "entry" is left out.
    """

    def linked(found: re.Match[str]) -> str:
        words, start, rest = found.groups()
        path = rest if start == "../" else f"docs/{start}{rest}"
        if config.repo_url:
            return f"[{words}]({config.repo_url.rstrip('/')}/blob/main/{path})"
        return f'<abbr title="{path}">{words}</abbr>'

    return OUTSIDE.sub(linked, markdown if config.repo_url else BARE.sub("", markdown))
