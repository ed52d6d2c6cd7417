"""``doit run view``: what it finds, follows and serves, in a browser and without; and its one file."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import pytest

from pipeline.avatar import save_avatar
from pipeline.avatar.storage import PREVIEW, save_preview
from pipeline.config.workspace import REPOSITORY, open_workspace
from pipeline.errors import UserError
from pipeline.store.artifact import SCRATCH, lock_of
from pipeline.viewer.page import viewer_page
from pipeline.viewer.server import LiveAvatar, ViewServer
from pipeline.viewer.shown import novel_motion, packed_avatar
from pipeline.viewer.source import AvatarSource
from tests.made.body import BODY_FILE
from tests.made.browser import NO_GL, SOFTWARE_GL, browser, opened, until
from tests.unit.test_avatar_representations import an_avatar

PICTURE = "window.avatarPage.view ? window.avatarPage.view.canvas.toDataURL() : ''"
READY = "!!(window.avatarPage.view && window.avatarPage.view.drawn && !window.avatarPage.view.asked)"
MOVE = """([name, value]) => {
    const one = document.querySelector(`[data-name='${name}']`);
    one.value = value;
    one.dispatchEvent(new Event("input"));
}"""
SHIPPED = "mannequin_full"


@pytest.fixture(scope="module")
def avatar(body):
    return an_avatar(body, "bases")


@pytest.fixture
def workspace(tmp_path, avatar):
    """A workspace in which somebody has an avatar that ships."""
    folder = tmp_path / "data" / "avatars" / "ann"
    folder.mkdir(parents=True)
    save_avatar(folder / "avatar.safetensors", avatar)
    return open_workspace(tmp_path / "data")


def training_leaves(workspace, subject="ann"):
    folder = workspace.artifacts / subject / "train" / ".scratch-0123456789abcdef" / "work"
    folder.mkdir(parents=True)
    return folder


@contextlib.contextmanager
def serving(workspace, subject="ann", host="127.0.0.1"):
    server = ViewServer(LiveAvatar(AvatarSource(workspace, subject)), host, 0)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join(5)


def get(url, **headers):
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as answer:
        return answer.read()


def status(url, **headers):
    with pytest.raises(urllib.error.HTTPError) as caught:
        get(url, **headers)
    return caught.value.code


def test_it_serves_the_page_the_avatar_and_nothing_else(workspace):
    with serving(workspace) as server:
        assert server.local and server.url.startswith("http://127.0.0.1:")
        assert b"<canvas" in get(server.url) and get(f"{server.url}avatar")[:2] == b"\x1f\x8b"
        assert "project" in json.loads(get(f"{server.url}state"))["said"]
        for path in ("frame/0", "frame/..%2F..%2Fetc", "../dodo.py", "etc/passwd", "frame/" + "9" * 40):
            assert status(server.url + path) == 404
        assert status(server.url, Host="elsewhere.example") == 403
        with pytest.raises(UserError, match="port="):
            ViewServer(server.live, "127.0.0.1", server.server_address[1])
        with pytest.raises(UserError, match="host="):
            ViewServer(server.live, "192.0.2.1", 0)


def test_it_follows_a_training_and_keeps_the_last_that_could_be_read(workspace, body):
    with serving(workspace) as server:
        first = json.loads(get(f"{server.url}state"))["stamp"]
        shown = get(f"{server.url}avatar")
        work = training_leaves(workspace)
        (work / PREVIEW).write_bytes(b"half of a file")
        state = json.loads(get(f"{server.url}state"))
        assert state["stamp"] == first and state["said"] and get(f"{server.url}avatar") == shown
        save_preview(work, an_avatar(body, "bases", awake=False))
        state = json.loads(get(f"{server.url}state"))
        assert state["stamp"] != first and "broken off" in state["said"]
        with lock_of(work.parents[1] / work.parent.name.removeprefix(SCRATCH)):
            assert "that runs" in json.loads(get(f"{server.url}state"))["said"]
        assert get(f"{server.url}avatar") != shown
        shutil.rmtree(work.parent)  # published, or given up
        assert json.loads(get(f"{server.url}state"))["stamp"] == first


def test_where_there_is_no_avatar_it_says_how_to_make_one(workspace):
    with pytest.raises(UserError, match="doit run subject=bob"):
        LiveAvatar(AvatarSource(workspace, "bob"))


def test_a_training_without_a_checkpoint_is_waited_for(workspace):
    work = training_leaves(workspace, "bob")
    with lock_of(work.parents[1] / work.parent.name.removeprefix(SCRATCH)):
        with pytest.raises(UserError, match="checkpoint_every"):
            LiveAvatar(AvatarSource(workspace, "bob"))
    with pytest.raises(UserError, match="doit run subject=bob"):
        LiveAvatar(AvatarSource(workspace, "bob"))


def test_an_avatar_of_another_version_is_refused_in_a_line(workspace):
    path = workspace.data / "avatars" / "ann" / "avatar.safetensors"
    path.write_bytes(path.read_bytes().replace(b"flexiavatar-avatar-", b"flexiavatar-AVATAR-"))
    with pytest.raises(UserError, match="train stage again"):
        LiveAvatar(AvatarSource(workspace, "ann"))


def run_view(*words, folder):
    line = [sys.executable, "-m", "doit", "run", "view", f"artifacts={folder}", *words]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(
        line, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip


@pytest.mark.slow
def test_the_avatar_that_comes_with_the_project_is_shown_and_ctrl_c_ends_it(tmp_path):
    started = run_view(f"subject={SHIPPED}", "port=0", folder=tmp_path)
    try:
        lines = iter(started.stdout.readline, "")
        said = next((line for line in lines if "http://127.0.0.1:" in line), "")
        url = next(word for word in said.split() if word.startswith("http"))
        assert len(get(f"{url}avatar")) < 4e6
        started.send_signal(signal.SIGINT)
        rest, _ = started.communicate(timeout=60)
        assert started.returncode == 0 and "Traceback" not in rest
    finally:
        started.kill()


@pytest.mark.parametrize(
    ("words", "saying"),
    [
        (("subject=smile", "port=0"), "doit run subject=smile"),
        (("subject=../../etc",), "a name is made of"),
        (("subject=smile,carphone",), "one subject"),
        ((f"subject={SHIPPED}", "port=70000"), "port"),
        ((f"subject={SHIPPED}", "train.seed=3"), "no effect"),
        ((f"subject={SHIPPED}", "motion=/no/such.bvh"), "no such file"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_a_line(tmp_path, words, saying):
    started = run_view(*words, folder=tmp_path)
    said, _ = started.communicate(timeout=120)
    assert started.returncode != 0 and saying in said and "Traceback" not in said, said


@pytest.fixture(scope="module")
def file(tmp_path_factory, avatar):
    """The page in one file."""
    path = tmp_path_factory.mktemp("page") / "avatar.html"
    packed = packed_avatar(avatar, None, [novel_motion(frames=8)], BODY_FILE)
    path.write_text(viewer_page("ann", packed, "data:video/mp4;base64,AAAA"), encoding="utf-8")
    return path


def looked_at(page, change=None):
    """The picture after a change, once it is drawn."""
    if change is not None:
        change()
        time.sleep(0.1)  # the next picture is asked for
    until(lambda: page.evaluate(READY))
    return page.evaluate(PICTURE)


def changes(page):
    """What a person can do, each with whether the picture must be another one then."""
    pick = lambda name, value: lambda: page.select_option(f"select[title='{name}']", value)  # noqa: E731
    yield "head", lambda: page.evaluate(MOVE, ["turn", 1.0])
    yield "jaw", lambda: page.evaluate(MOVE, ["jaw", 0.5])
    yield "smile", lambda: page.evaluate(MOVE, ["mouthSmileLeft", 1])
    yield "parts", pick("colours", "parts")
    yield "motion", pick("what it does", "-1")
    yield "reset", lambda: page.click(".reset")


@pytest.mark.slow
def test_the_file_shows_an_avatar_that_can_be_moved(file):
    with browser(*SOFTWARE_GL) as started:
        page, wrong = opened(started, file.as_uri())
        before = looked_at(page)
        for name, change in changes(page):
            after = looked_at(page, change)
            assert after != before, name
            before = after
        box = page.query_selector("canvas").bounding_box()
        page.mouse.move(box["x"] + 50, box["y"] + 50)
        page.mouse.down()
        page.mouse.move(box["x"] + 120, box["y"] + 80)
        page.mouse.up()
        assert looked_at(page, lambda: None) != before
        assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth") and wrong == []


def test_without_webgl_the_file_says_so_and_shows_the_film(file):
    with browser(*NO_GL) as started:
        page, wrong = opened(started, file.as_uri())
        until(lambda: page.is_visible("video.film"))
        assert "WebGL" in page.text_content(".said") and not page.is_visible("canvas")
        assert not [one for one in wrong if "WebGL" not in one]


@pytest.mark.slow
def test_the_served_page_follows_a_training(workspace, body):
    with serving(workspace) as server, browser(*SOFTWARE_GL) as started:
        page, wrong = opened(started, server.url, allowed=(server.url, "data:"))
        before = looked_at(page)
        assert looked_at(page, lambda: page.evaluate(MOVE, ["turn", 1.0])) != before
        before = page.evaluate(PICTURE)
        other = an_avatar(body, "bases")
        other.base_color += 2.0
        save_preview(training_leaves(workspace), other)
        until(lambda: page.evaluate(READY) and page.evaluate(PICTURE) != before)
        assert page.evaluate("window.avatarPage.view.values.turn") == 1 and wrong == []
