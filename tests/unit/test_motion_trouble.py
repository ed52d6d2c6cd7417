"""Motion files in other encodings, without a clock, or no files at all, and settings that cannot act."""

import codecs
import json
import os

import numpy as np
import pytest
import torch

from pipeline.body import load_body, mean_identity, rest_joints
from pipeline.config.settings import read_toml
from pipeline.errors import UserError
from pipeline.motion.bvh import read_bvh
from pipeline.untrusted import bounded_bytes, parse_json
from stages.animate.idle_settings import idle_settings
from stages.animate.motions.motion import Span
from stages.animate.motions.read import DrivenPerson, read_motion
from stages.animate.motions.source import motion_source
from stages.animate.settings import AnimateSettings
from tests.made.body import BODY_FILE
from tests.made.captured_skeletons import SKELETONS, write_captured
from tests.made.motions import made_up, write_fitted, write_folder

ENCODINGS = ("utf-8-sig", "utf-16")


@pytest.fixture(scope="module")
def person():
    body = load_body(BODY_FILE)
    return DrivenPerson(body, BODY_FILE, mean_identity(body))


@pytest.fixture(scope="module")
def truth():
    return made_up(3)


def read(path, person, folders=None):
    return read_motion(motion_source(str(path)), person, Span(), "auto", folders or {})


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_byte_order_mark_is_left_out_of_captures(tmp_path, person, truth, encoding):
    plain = write_captured(tmp_path / "a.bvh", *truth, person, SKELETONS["mixamo"])
    marked = write_captured(tmp_path / "b.bvh", *truth, person, SKELETONS["mixamo"], encoding=encoding)
    assert marked.read_bytes()[:2] in (codecs.BOM_UTF8[:2], codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    assert torch.equal(read(plain, person).rotation, read(marked, person).rotation)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_byte_order_mark_is_left_out_of_json_and_toml(tmp_path, person, truth, encoding):
    pivot = rest_joints(person.body, person.identity)[0].double()
    folder = write_folder(tmp_path / "poses", *truth, pivot, BODY_FILE)
    before = read(folder, person)
    for path in folder.iterdir():
        path.write_text(path.read_text(), encoding=encoding)
    assert torch.equal(read(folder, person).rotation, before.rotation)
    (tmp_path / "a.json").write_text('{"a": 1}', encoding=encoding)
    (tmp_path / "a.toml").write_text('title = "a man"\n', encoding=encoding)
    assert parse_json(tmp_path / "a.json", "") == {"a": 1}
    assert read_toml(tmp_path / "a.toml") == {"title": "a man"}


@pytest.mark.parametrize("rate", ["0", "0.000000", "nan", "inf", "-0.033", "33.333", "1e-9", "1e400", "fast"])
def test_a_frame_time_that_is_none_is_named(tmp_path, person, truth, rate):
    path = write_captured(tmp_path / "a.bvh", *truth, person, SKELETONS["mixamo"], rate=rate)
    with pytest.raises(UserError) as error:
        read_bvh(path)
    assert "a.bvh" in str(error.value) and rate in str(error.value)
    assert ("Frame Time" in str(error.value)) == (rate != "fast") and "channels" not in str(error.value)


def test_headers_as_loosely_written_as_programs_do(tmp_path, person, truth):
    plain = write_captured(tmp_path / "a.bvh", *truth, person, SKELETONS["mixamo"])
    text = plain.read_text()
    for old, new in (
        ("Frames: ", "FRAMES:\t"), ("Frame Time: ", "Frame Time:"), ("End Site {", "END SITE{"),
        ("Xrotation", "xrotation"), ("HIERARCHY", "Hierarchy"), ("OFFSET", "offset"), ("\n", "\r\n"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "b.bvh").write_bytes(text.encode())
    assert torch.equal(read(plain, person).rotation, read(tmp_path / "b.bvh", person).rotation)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (("Zrotation Xrotation Yrotation", "Zrotation Zrotation Yrotation"), "order of angles"),
        (("OFFSET 0 1 0", "OFFSET 0 1 0 CHANNELS 1 Xrotation"), "end site has channels"),
        (("OFFSET", "OFFSET nan 0 0 OFFSET"), "length of a bone"),
        (("OFFSET 0 1 0 }", "OFFSET 0 1 0"), "not closed"),
        (("Frames: 3", "Frames: 0"), "Frames: 0"),
        (("ROOT mixamorig:Hips", "ROOT"), "without a name"),
    ],
)
def test_a_damaged_skeleton_is_named(tmp_path, person, truth, change, word):
    path = write_captured(tmp_path / "a.bvh", *truth, person, SKELETONS["mixamo"])
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(UserError, match="a.bvh") as error:
        read_bvh(path)
    assert word in str(error.value)


def test_a_skeleton_without_lengths_is_refused_by_name(tmp_path, person, truth):
    path = write_captured(tmp_path / "a.bvh", *truth, person, SKELETONS["mixamo"], unit=0.0)
    with pytest.raises(UserError, match="a.bvh: bones"):
        read(path, person)


def test_what_is_no_motion_is_refused_in_a_line_and_without_waiting(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "a.png").write_text("x")
    os.mkfifo(tmp_path / "pipe.bvh")
    (tmp_path / "gone.bvh").symlink_to(tmp_path / "nowhere")
    for text in (
        "/dev/null", "/dev/zero", f"{tmp_path}/empty", f"{tmp_path}/pictures", f"{tmp_path}/pipe.bvh",
        f"{tmp_path}/gone.bvh", "x" * 5000 + ".bvh", "a\0b.bvh", "",
    ):  # fmt: skip
        with pytest.raises(UserError) as error:
            motion_source(text)
        message = str(error.value)
        assert message.startswith(f"motion={text[:100]}") and "\n" not in message and len(message) < 1000
        with pytest.raises(ValueError, match="motion="):
            AnimateSettings(motion=text)


def test_a_fifo_is_no_file_to_any_reader(tmp_path, person, truth):
    pivot = rest_joints(person.body, person.identity)[0].double()
    folder = write_folder(tmp_path / "poses", *truth, pivot, BODY_FILE)
    (folder / "5.json").unlink()
    for path in (folder / "5.json", tmp_path / "a.bvh"):
        os.mkfifo(path)
    with pytest.raises(UserError, match="5.json"):
        read(folder, person)
    for reader in (read_bvh, lambda path: bounded_bytes(path, 10, "name another")):
        with pytest.raises(UserError, match="a.bvh"):
            reader(tmp_path / "a.bvh")


def test_the_motion_of_a_folder_of_images_plays_at_the_usual_rate(tmp_path, person, truth):
    """Such a clip has no clock, and its seconds are the pictures' places: 0, 1, 2."""
    folders = write_fitted(tmp_path, *truth, person.identity, person.body)
    path = folders["ingest"] / "footage.json"
    footage = json.loads(path.read_text())
    path.write_text(json.dumps({**footage, "fps": 0.0, "seconds": [0.0, 1.0, 2.0]}))
    motion = read("subject:other", person, folders)
    assert motion.fps == 30.0 and any("no clock" in note for note in motion.notes)
    path.write_text(json.dumps({**footage, "fps": 1.0, "seconds": [0.0, 1.0, 2.0]}))
    assert read("subject:other", person, folders).fps == 1.0


@pytest.mark.parametrize(
    ("kind", "given", "idle"),
    [
        ("bvh", {"up": "z", "first_frame": 1, "way": "still"}, set()),
        ("amass", {"up": "-y"}, set()),
        ("peers", {"up": "z", "last_frame": 3}, {"up"}),
        ("subject", {"up": "y"}, {"up"}),
        ("turntable", {"up": "y", "first_frame": 1, "fps": 5.0, "way": "still", "turns": 2.0},
         {"up", "first_frame", "fps", "way"}),
        ("turntable", {"turns": 2.0, "camera": "clip"}, {"turns"}),
        ("bvh", {"turntable_frames": 3, "arm_angle": 1.0}, {"turntable_frames", "arm_angle"}),
        ("amass", {"turns": 2.0}, {"turns"}),
        ("bvh", {"turns": 2.0, "camera": "orbit"}, set()),
        ("bvh", {}, set()),
    ],
)  # fmt: skip
def test_settings_that_cannot_act_are_told(kind, given, idle):
    said = idle_settings(AnimateSettings(**given), kind, gated=True)
    assert {sentence.split("=")[0] for sentence in said} == {f"animate.{name}" for name in idle}
    assert all("no effect" in sentence for sentence in said)


def test_unseen_cannot_act_where_all_was_seen():
    settings = AnimateSettings(unseen="base")
    assert idle_settings(settings, "bvh", gated=False) and not idle_settings(settings, "bvh", gated=True)


def test_a_lone_frame_is_a_motion(tmp_path, person):
    np.savez(tmp_path / "a.npz", poses=np.zeros((1, 66)))
    assert len(read(tmp_path / "a.npz", person)) == 1
