"""A browser, pages whose consoles have to stay empty, and a server that answers them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator

import pytest

pytest.importorskip("playwright", reason="Playwright isn't installed: the pages aren't tried in a browser")
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from browser.fake import Complaints, Fake


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    path = os.environ.get("PLAYWRIGHT_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("there is no Chromium: install one, or name it in PLAYWRIGHT_CHROMIUM")
    with sync_playwright() as playwright:
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
    context = browser.new_context(viewport={"width": 1366, "height": 768})
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
