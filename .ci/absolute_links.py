"""Makes the links and pictures of a page absolute, for a package index that has no other file.

python .ci/absolute_links.py README.md https://github.com/OWNER/NAME TAG
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

RELATIVE = r"(?![a-z]+:|//|#)"
"""Before a target that is a file of the repository."""
PICTURE = re.compile(rf"(!\[[^\]]*\]\(|\b(?:src|srcset)=\"){RELATIVE}([^)\"\s]+)")
WORDS = r"(?:[^\[\]]|!?\[[^\]]*\](?:\([^)]*\))?)+"
"""Of a link, a picture among them."""
LINK = re.compile(rf"((?<!!)\[{WORDS}\]\(|\bhref=\"){RELATIVE}([^)\"\s]+)")


def absolute(text: str, repository: str, ref: str) -> str:
    """The page with every file of the repository by its address at a tag or branch."""
    text = PICTURE.sub(rf"\g<1>{repository}/raw/{ref}/\g<2>", text)
    return LINK.sub(rf"\g<1>{repository}/blob/{ref}/\g<2>", text)


if __name__ == "__main__":
    page = Path(sys.argv[1])
    page.write_text(absolute(page.read_text(), *sys.argv[2:]))
