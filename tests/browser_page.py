"""Pages of skindb in a headless browser."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

import pytest
from waiting import PATIENCE_SECONDS

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def started_browser():
    """A Chromium; the test is skipped if it, or Playwright, is absent."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed"
    )
    if BROWSER is None:
        pytest.skip("there is no Chromium")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=BROWSER, args=FLAGS)
        yield browser
        browser.close()


def opened(browser, address, *, width=620, height=320, motion="reduce"):
    """A page of skindb that is ready; `problems` collects its errors."""
    size = {"width": width, "height": height}
    page = browser.new_page(viewport=size, reduced_motion=motion)
    page.set_default_timeout(1000 * PATIENCE_SECONDS)
    page.problems = []
    page.on(
        "console",
        lambda said: page.problems.append(said.text) if said.type == "error" else None,
    )
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.goto(address)
    page.evaluate("skindb.ready")
    assert "token" not in page.url
    return page


def inaccessible(page):
    """What axe objects to, with all parts of the page open."""
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright",
        reason="axe-playwright-python is not installed",
    )
    page.evaluate(
        "document.querySelectorAll('details').forEach((one) => { one.open = true; })"
    )
    result = axe.Axe().run(page)
    assert result.response["passes"] is not None
    return [
        (rule["id"], node["html"][:120])
        for rule in result.response["violations"]
        for node in rule["nodes"]
    ]
