"""What the site has beside the pages of this folder: pages from the repository's root, the tour, and measured pictures.

mkdocs calls the two functions below (`hooks` in mkdocs.yml). Links on every page are written as they work in the repository;
here they are turned into those that work on the site.
"""

from __future__ import annotations

import re
from pathlib import Path

import jupytext
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
# pages of the repository's root by their names on the site
ROOT_PAGES = {"index.md": "README.md", "contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}


def on_files(files: Files, config) -> Files:
    """Adds what lies outside of docs/."""
    for name, source in ROOT_PAGES.items():
        files.append(File.generated(config, name, content=for_site((ROOT / source).read_text(encoding="utf-8"))))
    tour = jupytext.read(ROOT / "docs" / "tour.py")
    tour.metadata.clear()
    text = "\n\n".join(_as_markdown(cell) for cell in tour.cells)
    files.append(File.generated(config, "tour.md", content=for_site(text)))
    for picture in sorted((*RESULTS.glob("*.png"), *RESULTS.glob("*.gif"))):
        files.append(File.generated(config, f"results/{picture.name}", abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page, **_) -> str:
    """The page with the site's links."""
    return for_site(markdown)


def for_site(text: str) -> str:
    """`text` with links to where things lie on the site."""
    text = re.sub(r"\]\((\.\./)?benchmarks/results/", "](results/", text)
    text = re.sub(r"\]\(docs/", "](", text).replace("](tour.py)", "](tour.md)")
    for name, source in ROOT_PAGES.items():
        text = re.sub(rf"\]\((\.\./)?{re.escape(source)}", f"]({name}", text)
    return text.replace("[how to cite](CITATION.cff)", "how to cite: `CITATION.cff`")


def _as_markdown(cell) -> str:
    """A cell of the tour: its text, or its code as a block."""
    if cell.cell_type == "markdown":
        return cell.source
    code = re.sub(r"^%.*\n", "", cell.source, flags=re.MULTILINE)
    return f"```python\n{code}\n```"
