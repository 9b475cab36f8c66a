"""A page in headless Chromium, drawn in software."""

from __future__ import annotations

import atexit
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

CHROMIUM = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
]  # fmt: skip


@cache
def chromium():
    """One browser a process: Playwright allows no second."""
    from playwright.sync_api import sync_playwright

    playwright = sync_playwright().start()
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
    atexit.register(lambda: (browser.close(), playwright.stop()))
    return browser


@contextmanager
def opened(file: Path, **context) -> Iterator[tuple]:
    """The page and a list that gathers what it complains of; context: what Playwright's `new_context` takes."""
    here = chromium().new_context(**context)
    page, complaints = here.new_page(), []
    page.on(
        "console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None
    )
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on(
        "request",
        lambda request: complaints.append(request.url) if not request.url.startswith(("file:", "data:")) else None,
    )
    page.set_default_timeout(120000)  # software draws slowly on a busy machine
    page.goto(file.resolve().as_uri())
    yield page, complaints
    here.close()
