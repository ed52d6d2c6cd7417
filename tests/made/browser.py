"""The Chromium that is installed, headless, and a page of which it is noted what goes wrong."""

import contextlib
import shutil
import time

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
QUIET = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NO_GL = ("--disable-gpu", "--disable-3d-apis")


@contextlib.contextmanager
def browser(*flags):
    """A browser; the test is skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here")
    with playwright.sync_playwright() as session:
        started = session.chromium.launch(executable_path=CHROMIUM, args=[*QUIET, *flags])
        yield started
        started.close()


def opened(started, address, width=390, height=700, allowed=("file:", "data:")):
    """A page at an address, and a list that gets all that goes wrong with it."""
    page, wrong = started.new_page(viewport={"width": width, "height": height}, device_scale_factor=1), []
    page.on("console", lambda one: wrong.append(one.text) if one.type == "error" else None)
    page.on("pageerror", lambda one: wrong.append(str(one)))
    page.on("request", lambda one: None if one.url.startswith(allowed) else wrong.append(one.url))
    page.goto(address, wait_until="load")
    return page, wrong


def until(asked, seconds=60):
    """Waits until something is true; AssertionError where it never is."""
    end = time.monotonic() + seconds
    while not asked():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.05)
