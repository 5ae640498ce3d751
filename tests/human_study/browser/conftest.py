"""A browser, pages whose consoles have to stay empty, and a server that answers them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from browser.fake import Complaints, Fake

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page


@pytest.fixture(scope="package")  # longer, its event loop would be in other tests' way
def browser() -> Iterator[Browser]:
    reason = "Playwright isn't installed: the pages aren't tried in a browser"
    api = pytest.importorskip("playwright.sync_api", reason=reason)
    with api.sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        path = (
            os.environ.get("PLAYWRIGHT_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser") or own
        )
        if not Path(path).exists():
            pytest.skip("there is no Chromium: install one, or name it in PLAYWRIGHT_CHROMIUM")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def complaints() -> Iterator[Complaints]:
    """Every test's pages must be quiet; a test that cuts a connection takes out what browsers say of that."""
    found = Complaints()
    yield found
    assert not found


@pytest.fixture
def context(browser, complaints) -> Iterator[BrowserContext]:
    context = browser.new_context(viewport={"width": 1024, "height": 640})
    context.set_default_timeout(10_000)
    complaints.watch(context)
    yield context
    context.close()


@pytest.fixture
def page(context) -> Page:
    return context.new_page()


@pytest.fixture
def fake() -> Fake:
    return Fake()
