"""Copies measured tables into the README and the pages beside it, so that no figure there is typed by hand.

    make readme

A table stands between `<!-- begin FILE -->` and `<!-- end -->`; FILE is what a measuring command wrote. Pictures that it shows
lie beside it.
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "cluster.md", ROOT / "docs" / "ablations.md")


def embedded(text: str) -> str:
    """`text` with every marked place holding its file's content."""

    def replace(match: re.Match) -> str:
        folder = match[1].rpartition("/")[0]
        content = re.sub(
            r"\]\((?=[^)/]+\.png\))", f"]({folder}/", (ROOT / match[1]).read_text(encoding="utf-8").strip()
        )
        return f"<!-- begin {match[1]} -->\n{content}\n<!-- end -->"

    return re.sub(r"<!-- begin (\S+) -->\n.*?<!-- end -->", replace, text, flags=re.DOTALL)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(embedded(page.read_text(encoding="utf-8")), encoding="utf-8")
