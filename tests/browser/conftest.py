"""One Chromium for all tests of pages; a page of its own for each.

Without a browser these tests are skipped with the reason; ``HIL_REQUIRE_BROWSER=1`` makes that a failure.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.browser.chromium import Browser, BrowserError, Page, chromium


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A headless Chromium."""
    try:
        running = chromium()
        one = running.__enter__()
    except (BrowserError, OSError) as error:
        if os.environ.get("HIL_REQUIRE_BROWSER") == "1":
            pytest.fail(f"a browser is required here: {error}")
        pytest.skip(str(error))
    yield one
    running.__exit__(None, None, None)


@pytest.fixture
def page(browser: Browser) -> Page:
    """An empty page."""
    return browser.page()
