"""The avatar itself in the report, opened from a file in headless Chromium."""

import pytest

from pipeline.viewer.shown import novel_motion, packed_avatar
from tests.made.blob import TEST, make_clip
from tests.made.body import BODY_FILE
from tests.made.browser import NO_GL, SOFTWARE_GL, browser, opened, until
from tests.unit.test_avatar_representations import an_avatar


@pytest.fixture(scope="module")
def with_avatar(tmp_path_factory, body):
    """A report with the avatar itself in it."""
    packed = packed_avatar(an_avatar(body, "bases"), None, [novel_motion(frames=4)], BODY_FILE)
    output = make_clip(tmp_path_factory.mktemp("blob")).evaluate(packed=packed)
    assert (output / "avatar.html").stat().st_size > len(packed)
    return output / "report.html"


def test_the_avatar_in_the_report_is_drawn_when_it_comes_into_sight(with_avatar):
    with browser(*SOFTWARE_GL) as started:
        page, wrong = opened(started, with_avatar.as_uri())
        page.evaluate("document.querySelector('.avatar-view').scrollIntoView()")
        until(lambda: page.evaluate("!!(window.avatarPage.view && window.avatarPage.view.drawn)"))
        assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth") and wrong == []


def test_without_webgl_the_report_says_so_in_a_line_and_stays_usable(with_avatar):
    with browser(*NO_GL) as started:
        page, _ = opened(started, with_avatar.as_uri())
        page.evaluate("document.querySelector('.avatar-view').scrollIntoView()")
        until(lambda: "WebGL" in page.text_content(".avatar-view .said"))
        assert not page.is_visible("canvas")
        page.click("[data-step='1']")
        assert page.text_content("#frame-said").startswith(f"Frame {TEST[1]},")
