"""What the site changes in the pages: links to files that it leaves out become words."""

from __future__ import annotations

import re
from typing import Any

OUTSIDE = re.compile(r"\[((?:[^\[\]]|\[[^\]]*\])+)\]\((\.\./|decisions\.md)([^)\s]*)\)")


def on_page_markdown(markdown: str, config: Any, **_: Any) -> str:
    """The page with links to the repository's files; without its address, with their names."""

    def linked(found: re.Match[str]) -> str:
        words, start, rest = found.groups()
        path = rest if start == "../" else f"docs/{start}{rest}"
        if config.repo_url:
            return f"[{words}]({config.repo_url.rstrip('/')}/blob/main/{path})"
        return f'<abbr title="{path}">{words}</abbr>'

    return OUTSIDE.sub(linked, markdown)
