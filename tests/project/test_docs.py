"""The site is built from the pages without a warning, and holds what they show."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_is_there(site):
    pages = {path.parent.relative_to(site).as_posix() for path in site.rglob("index.html")}
    written = {path.relative_to(ROOT / "docs").with_suffix("").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert pages >= written | {".", "tour", "contributing", "changelog"}
    assert "Your own environment" in (site / "index.html").read_text(encoding="utf-8")
    assert "surrogate_values" in (site / "tour" / "index.html").read_text(encoding="utf-8")


def test_pictures_and_local_links_lead_somewhere(site):
    lost = []
    for page in site.rglob("index.html"):
        for target in re.findall(r'(?:href|src)="([^"#?:]+)(?=["#?])', page.read_text(encoding="utf-8")):
            if not target.startswith("/") and not (page.parent / target).exists():
                lost.append((page.relative_to(site).as_posix(), target))
    assert not lost


def test_the_reference_is_made_of_the_docstrings(site):
    reference = (site / "api" / "environments" / "index.html").read_text(encoding="utf-8")
    assert "The part of a state that people compare" in reference
    assert 'id="peps_envs.environment.Environment.step"' in reference
    assert 'id="peps_jax.train.train"' in (site / "api" / "training" / "index.html").read_text(encoding="utf-8")


def test_nothing_is_loaded_from_elsewhere(site):
    text = (site / "index.html").read_text(encoding="utf-8")
    assert not re.findall(r'<(?:script|link)[^>]+(?:src|href)="https?://[^"]*\.(?:js|css|woff2?)', text)


def test_a_page_with_a_dead_link_is_refused(tmp_path):
    """What `--strict` is for."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[nowhere](nowhere.md)", encoding="utf-8")
    (tmp_path / "mkdocs.yml").write_text("site_name: x\n", encoding="utf-8")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict"]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True, check=False).returncode != 0
