"""The report opened from a file in headless Chromium, at the width of a desk and of a phone."""

import numpy as np
import pytest

from pipeline.clip.frames import write_png
from stages.evaluate.scores import TableRow
from stages.evaluate.second_mask import SecondMask, edge
from tests.made.blob import TEST, make_clip
from tests.made.browser import browser

EVERY_PICTURE = """() => [...document.images].map(one => [one.alt, one.complete && one.naturalWidth > 0])"""
EVERY_VIDEO = """() => Promise.all([...document.querySelectorAll("video")].map(one => new Promise(done => {
    if (one.error || one.readyState > 0) done(!one.error);
    one.addEventListener("loadedmetadata", () => done(true));
    one.addEventListener("error", () => done(false));
    setTimeout(() => done(false), 5000);
})))"""
BREAKS_OUT = """() => [...document.querySelectorAll("main *")].filter(one =>
    one.getBoundingClientRect().right > innerWidth + 1 && !one.closest(".wide"))
    .map(one => one.outerHTML.slice(0, 80))"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report with everything in it that a report can have."""
    clip = make_clip(tmp_path_factory.mktemp("blob"), soft=True)
    write_png(clip.inputs["fit"] / "overlay.png", np.full((48, 64, 3), 90, np.uint8))
    write_png(clip.inputs["train"] / "visibility.png", np.full((48, 64, 3), 120, np.uint8))
    evaluated = clip.clip()
    second = SecondMask(evaluated, {frame: edge(evaluated.mask(frame)) for frame in TEST}, "1 px smaller")
    rows = [TableRow(2, "views", "avatar", name, 20.0, "back") for name in ("psnr", "psnr_unseen")]
    output = clip.evaluate(second=second, other_cameras=rows, refine_test_poses="on", refine_steps=2)
    return output / "report.html"


@pytest.fixture(scope="module")
def chromium():
    """The browser, started once."""
    with browser("--disable-gpu") as started:
        yield started


@pytest.fixture(params=[(1280, 800), (390, 844)], ids=["desk", "phone"])
def page(request, chromium, report):
    """The report in a window, and all that went wrong with it."""
    width, height = request.param
    page = chromium.new_page(viewport={"width": width, "height": height}, device_scale_factor=1)
    wrong = []
    page.on("console", lambda one: wrong.append(one.text) if one.type in ("error", "warning") else None)
    page.on("pageerror", lambda one: wrong.append(str(one)))
    page.on("requestfailed", lambda one: wrong.append(one.url[:100]))
    page.on("request", lambda one: None if one.url.startswith(("file:", "data:")) else wrong.append(one.url))
    page.goto(report.as_uri(), wait_until="load")
    yield page, wrong
    page.close()


def test_it_opens_without_an_error_and_every_picture_loads(page):
    shown, wrong = page
    pictures = shown.evaluate(EVERY_PICTURE)
    assert len(pictures) > 10 and [alt for alt, loaded in pictures if not loaded] == []
    assert shown.evaluate(EVERY_VIDEO) == [True, True]
    assert wrong == []


def test_nothing_is_wider_than_the_window(page):
    shown, _ = page
    assert shown.evaluate(BREAKS_OUT) == []
    assert shown.evaluate("document.scrollingElement.scrollWidth <= innerWidth")


def test_the_slider_goes_through_the_frames(page):
    shown, wrong = page

    def visible():
        return [
            one.get_attribute("data-said") for one in shown.query_selector_all(".slide") if one.is_visible()
        ]

    assert visible()[0].startswith(f"Frame {TEST[0]},") and len(visible()) == 1
    shown.click("[data-step='1']")
    assert visible()[0].startswith(f"Frame {TEST[1]},") and len(visible()) == 1
    shown.fill("#frame", "2")
    assert visible()[0].startswith(f"Frame {TEST[2]},") and len(visible()) == 1
    shown.click("[data-step='1']")  # round to the first
    assert visible()[0].startswith(f"Frame {TEST[0]},")
    assert shown.text_content("#frame-said") == visible()[0] and wrong == []


def test_a_foreign_script_is_not_run_and_a_broken_picture_is_noticed(report, chromium, tmp_path):
    other, text = tmp_path / "report.html", report.read_text()
    text = text.replace("data:image/jpeg;base64,", "data:image/jpeg;base64,AAAA", 1)
    other.write_text(text.replace("</main>", "<script>document.title = 'run'</script></main>"))
    wrong = []
    page = chromium.new_page()
    page.on("console", lambda one: wrong.append(one.text) if one.type == "error" else None)
    page.goto(other.as_uri())
    assert "FlexiAvatar" in page.title() and "Content Security Policy" in wrong[0]
    assert [loaded for _, loaded in page.evaluate(EVERY_PICTURE)].count(False) == 1
    page.close()
