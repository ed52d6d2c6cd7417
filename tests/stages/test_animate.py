"""The animate stage: what it writes, and that other readers read it."""

import dataclasses
import json

import av
import cv2
import gsply
import numpy as np
import pytest
import roma
import torch

from pipeline.avatar import pose_features
from pipeline.body import PARTS, joint_index, mean_identity, pose_body, rest_joints
from pipeline.clip.camera import facing_camera
from pipeline.clip.records import read_cameras
from pipeline.errors import UserError
from pipeline.splat import Gaussians, render
from stages.animate.actor import PoseRange, legs_share
from stages.animate.exr_layers import decode_srgb, exr_layers
from stages.animate.run import on_background
from tests.exr_reader import ffmpeg_colors, read_exr
from tests.glb_reader import read_splat_glb
from tests.made.body import open_body
from tests.made.doll import awake_avatar, make_studio
from tests.made.motions import FPS, made_up, write_npz
from tests.made.portrait import moving_poses
from tests.ply_reader import read_ply

COUNT = 5
GREY = 0xD1 / 255


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    return make_studio(tmp_path_factory.mktemp("studio"))


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    rotation, way = made_up(COUNT)
    rotation[:, 0] = 0
    pivot = rest_joints(open_body(), mean_identity(open_body()))[0].double()
    return write_npz(tmp_path_factory.mktemp("motion") / "walk.npz", rotation, way, pivot)


@pytest.fixture(scope="module")
def everything(studio, walk):
    """A walk as video, OpenEXR and splats."""
    return studio.animate("everything", motion=str(walk), outputs=("video", "exr", "ply"))


def video(path):
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate)
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]), rate


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def filmed(context, frame):
    """A frame's splats and camera, as they were published."""
    camera = read_cameras(context.output / "cameras.parquet")[frame]
    return read_ply(context.output / "ply" / f"{frame:06d}.ply"), camera


def encode_srgb(linear):
    """The other direction, written anew."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_only_what_is_asked_for_is_written(studio, walk):
    plain = studio.animate("plain", motion=str(walk))
    assert names(plain.output) == [
        "animate.json",
        "animation.mp4",
        "cameras.parquet",
        "frames.png",
        "motion.parquet",
    ]
    assert set(plain.timings["milliseconds_a_frame"]) == {"pose", "render"}
    frames, rate = video(plain.output / "animation.mp4")
    assert frames.shape == (COUNT, 64, 48, 3) and rate == pytest.approx(FPS)
    splats = studio.animate("splats", motion=str(walk), outputs=("ply",), last_frame=1)
    assert names(splats.output) == ["animate.json", "cameras.parquet", "frames.png", "motion.parquet", "ply"]
    assert names(splats.output / "ply") == ["000000.ply", "000001.ply"]


def test_splats_of_all_formats_hold_the_same_gaussians(studio, walk):
    context = studio.animate("formats", motion=str(walk), outputs=("ply", "spz", "glb"), last_frame=1)
    for frame in ("000000", "000001"):
        expected = read_ply(context.output / "ply" / f"{frame}.ply")
        found = read_splat_glb(context.output / "glb" / f"{frame}.glb")
        assert torch.allclose(found.means, expected.means) and torch.allclose(found.scales, expected.scales)
        packed = gsply.read_spz(context.output / "spz" / f"{frame}.spz")
        assert np.abs(packed.means - expected.means.numpy()).max() < 5e-5
    assert {"ply", "spz", "glb"} < set(context.timings["milliseconds_a_frame"])


def test_equal_runs_give_equal_bytes(studio, walk, everything):
    again = studio.animate("again", motion=str(walk), outputs=("video", "exr", "ply"))
    for path in sorted(everything.output.rglob("*.*")):
        assert path.read_bytes() == (again.output / path.relative_to(everything.output)).read_bytes(), path


def on_sheet(context, frame):
    """A frame's picture on the contact sheet, where it is as large as it was drawn."""
    sheet = cv2.imread(str(context.output / "frames.png"))[..., ::-1]
    row, column = divmod(frame, 4)
    top, left = row * (22 + 64 + 4) + 22, column * (48 + 4)
    return sheet[top : top + 64, left : left + 48].astype(float)


def test_the_splats_read_back_draw_the_same_picture(everything):
    frames, _ = video(everything.output / "animation.mp4")
    luma = np.array([0.299, 0.587, 0.114])
    for frame in range(COUNT):
        drawn = on_background(render(*filmed(everything, frame)), (GREY,) * 3).astype(float)
        assert drawn.std() > 20 and np.abs(drawn - on_sheet(everything, frame)).max() <= 1
        assert np.abs((drawn - frames[frame]) @ luma).mean() < 3  # H.264 loses some of it


def test_the_layers_are_named_and_read_by_other_readers(everything):
    path = everything.output / "exr" / "000002.exr"
    layers = read_exr(path)
    assert {name: set(channels) for name, channels in layers.items()} == {
        "beauty": set("RGBA"), "alpha": {"A"}, "depth": {"Z"}, "normal": set("XYZ"), "part": {"ID"},
    }  # fmt: skip
    assert all(one.shape == (64, 48) for channels in layers.values() for one in channels.values())
    beauty = np.stack([layers["beauty"][letter] for letter in "RGB"], -1).astype(np.float32)
    np.testing.assert_array_equal(ffmpeg_colors(path), beauty)
    np.testing.assert_array_equal(layers["beauty"]["A"], layers["alpha"]["A"])


def test_beauty_over_the_background_is_the_videos_picture(everything):
    for frame in (0, COUNT - 1):
        beauty = read_exr(everything.output / "exr" / f"{frame:06d}.exr")["beauty"]
        light = np.stack([beauty[letter] for letter in "RGB"], -1).astype(float)
        alpha = beauty["A"].astype(float)[..., None]
        straight = encode_srgb(light / np.maximum(alpha, 1e-6))
        picture = 255 * (straight * alpha + GREY * (1 - alpha))
        drawn = on_background(render(*filmed(everything, frame)), (GREY,) * 3)
        assert np.abs(picture - drawn).max() < 1.5 and alpha.max() > 0.99 and alpha.min() == 0


def test_depth_normal_and_part_are_those_of_the_body(everything):
    layers = read_exr(everything.output / "exr" / "000000.exr")
    gaussians, camera = filmed(everything, 0)
    alpha, depth = layers["alpha"]["A"], layers["depth"]["Z"]
    solid = alpha > 0.99
    away = (gaussians.means @ camera.rotation.T + camera.translation)[:, 2]
    assert (depth[solid] > float(away.min()) - 0.01).all() and (depth[solid] < float(away.max()) + 0.01).all()
    assert (depth[alpha == 0] == 1e10).all()
    normal = np.stack([layers["normal"][letter] for letter in "XYZ"], -1).astype(float)
    np.testing.assert_allclose(np.linalg.norm(normal[solid], axis=-1), 1, atol=2e-3)
    assert (normal[alpha == 0] == 0).all() and normal[solid][:, 2].mean() > 0.5  # towards the camera at +Z
    part = layers["part"]["ID"]
    assert (part[alpha == 0] == 0).all()
    shown = {PARTS[int(number) - 1] for number in np.unique(part[solid])}
    assert {"torso", "left_leg", "right_leg", "left_arm", "right_arm"} <= shown
    left, right, torso = (
        np.nonzero(part == 1 + PARTS.index(name)) for name in ("left_leg", "right_leg", "torso")
    )
    assert left[1].mean() > right[1].mean() + 2  # the subject's left is on the picture's right
    assert left[0].mean() > torso[0].mean() + 5


def test_layers_of_two_flat_discs_by_hand():
    means = torch.tensor([[-0.5, 0.0, -2.0], [0.5, 0.0, -4.0]])
    turned = roma.rotvec_to_unitquat(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.6, 0.0]]))
    colors = torch.tensor([[0.5, 0.02, 1.0], [0.2, 0.9, 0.0]])
    discs = Gaussians(
        means, roma.quat_xyzw_to_wxyz(turned), torch.tensor([[0.2, 0.2, 1e-3]]).expand(2, 3), colors,
        torch.full((2,), 0.95),
    )  # fmt: skip
    camera = facing_camera(80, 40, 60.0)
    layers = exr_layers(discs, torch.tensor([4, 7]), camera, render(discs, camera))
    pixels = [(20, 25), (20, 47)]  # columns 40 - 0.5 * 60 / 2 and 40 + 0.5 * 60 / 4
    for (row, column), color, depth, part, angle in zip(
        pixels, colors, (2.0, 4.0), (5, 8), (0.0, 0.6), strict=True
    ):
        pixel = layers.beauty[row, column]
        assert torch.allclose(pixel[:3] / pixel[3], decode_srgb(color), atol=1e-5)
        assert layers.depth[row, column] == pytest.approx(depth, abs=1e-4)
        assert layers.part[row, column] == part
        facing = torch.tensor([np.sin(angle), 0.0, np.cos(angle)], dtype=torch.float32)
        assert torch.allclose(layers.normal[row, column], facing, atol=1e-5)
    assert decode_srgb(torch.tensor(0.5)) == pytest.approx(0.21404, abs=1e-5)
    assert decode_srgb(torch.tensor(0.02)) == pytest.approx(0.02 / 12.92)


def test_a_subjects_own_clip_filmed_from_where_it_was_is_the_clip_again(studio):
    """Driven by its own fit, the avatar stands before its own camera as it did."""
    context = studio.animate(
        "own", motion="subject:doll", camera="clip", way="kept", heads="free", outputs=("ply",), bake="off",
        loans={stage: studio.root / stage for stage in ("ingest", "fit")},
    )  # fmt: skip
    avatar, poses = awake_avatar(), moving_poses()
    original = facing_camera(48, 64, 1.2 * 64)
    for frame in (0, 5):
        with torch.no_grad():
            there = avatar.gaussians(poses.pose(frame))
            ours = render(*filmed(context, frame)).color
            assert float((ours - render(there, original).color).abs().mean()) < 2e-3
    about = json.loads((context.output / "animate.json").read_text())
    assert about["source_frames"] == list(range(6)) and about["fps"] == pytest.approx(10.0)


def test_a_turntable_stands_still_and_goes_round(studio):
    context = studio.animate("turn", outputs=("video", "ply"), camera="orbit")
    assert names(context.output / "ply") == ["000000.ply"]  # one pose, one file
    frames, rate = video(context.output / "animation.mp4")
    cameras = read_cameras(context.output / "cameras.parquet")
    assert len(frames) == 4 and rate == pytest.approx(8.0)
    places = torch.stack([cameras[k].centre - cameras[0].centre for k in range(4)])
    assert float(places[2].norm()) == pytest.approx(2 * float(places[1].norm()) / 2**0.5, rel=1e-3)
    means = read_ply(context.output / "ply" / "000000.ply").means
    width = means.amax(0) - means.amin(0)
    assert width[0] > 1.4  # the paper's supplement turns the T pose
    assert json.loads((context.output / "animate.json").read_text())["motion"] == "turntable"


def test_a_run_says_which_settings_have_no_effect(studio, capsys):
    context = studio.animate("idle", up="z", turntable_frames=2)
    found = json.loads((context.output / "animate.json").read_text())
    assert len(found["without_effect"]) == 1 and "animate.up=z" in found["without_effect"][0]
    assert "animate.up=z" in capsys.readouterr().out


def test_an_orbit_goes_round_a_moving_body_and_nothing_is_cut_off(studio, walk):
    context = studio.animate("round", motion=str(walk), camera="orbit", outputs=("exr",))
    cameras = read_cameras(context.output / "cameras.parquet")
    assert len({tuple(camera.centre.tolist()) for camera in cameras.values()}) == COUNT
    for frame in range(COUNT):
        alpha = read_exr(context.output / "exr" / f"{frame:06d}.exr")["alpha"]["A"].astype(float)
        edge = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
        assert edge.max() < 0.1 and alpha.max() > 0.9


def test_the_front_camera_holds_the_whole_walk(everything):
    cameras = read_cameras(everything.output / "cameras.parquet")
    assert all(torch.equal(camera.translation, cameras[0].translation) for camera in cameras.values())
    alpha = [
        read_exr(path)["alpha"]["A"].astype(float) for path in sorted((everything.output / "exr").iterdir())
    ]
    seen = np.maximum.reduce(alpha)
    assert max(seen[0].max(), seen[-1].max(), seen[:, 0].max(), seen[:, -1].max()) < 0.1
    rows, columns = np.nonzero(seen > 0.5)
    assert max(np.ptp(rows) / 64, np.ptp(columns) / 48) > 0.6


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """Somebody who was never seen below the waist."""
    return make_studio(tmp_path_factory.mktemp("half"), gated=True)


def about(context):
    return json.loads((context.output / "animate.json").read_text())


def test_without_legs_nobody_walks_and_what_was_not_seen_is_not_shown(half, walk):
    context = half.animate("auto", motion=str(walk), outputs=("ply",), last_frame=3)
    found = about(context)
    assert not found["way"]["kept"] and found["way"]["share_of_legs"] < found["way"]["threshold"]
    assert found["unseen"] == "nothing" and found["gaussians"] == len(awake_avatar(gated=True))
    kept = half.animate("kept", motion=str(walk), outputs=("ply",), last_frame=3, way="kept")
    still, moving = (
        [read_ply(one.output / "ply" / f"00000{k}.ply").means.mean(0) for k in (0, 3)]
        for one in (context, kept)
    )
    assert float((still[1] - still[0]).norm()) < 0.5 * float((moving[1] - moving[0]).norm())


@pytest.mark.parametrize("baking", ["on", "off"])
def test_the_unseen_body_can_be_shown_in_its_base_colours(half, walk, baking):
    context = half.animate(
        f"base-{baking}", motion=str(walk), outputs=("exr",), unseen="base", last_frame=0, bake=baking
    )
    assert about(context)["gaussians"] == len(open_body().v_template)
    part = read_exr(context.output / "exr" / "000000.exr")["part"]["ID"]
    assert 1 + PARTS.index("left_leg") in part


def test_heads_are_told_of_poses_that_training_showed():
    poses = moving_poses()
    known = PoseRange.of(poses, poses.frames[:-1])
    pose = poses.pose(poses.frames[2])
    inside, far = pose_features(pose.rotation), pose.rotation.clone()
    assert torch.equal(known.nearest(pose), inside)
    far[joint_index("left_knee")] = torch.tensor([1.5, 0.0, 0.0])  # nobody saw a knee bend
    far[joint_index("head"), 0] = 0.8  # it nodded by 0.1
    told = known.nearest(dataclasses.replace(pose, rotation=far)).view(54, 3, 2)
    assert torch.equal(told[joint_index("left_knee") - 1], inside.view(54, 3, 2)[3])
    nod = torch.asin(told[joint_index("head") - 1, 2, 1])
    assert 0.05 < float(nod) <= 0.1 + 1e-5


def test_how_much_of_the_legs_there_is():
    body = open_body()
    assert legs_share(awake_avatar(), body) == 1 and legs_share(awake_avatar(gated=True), body) < 0.2


def test_baked_or_not_the_picture_is_the_same(studio, walk, everything):
    baked = studio.animate("baked", motion=str(walk), outputs=("ply",), bake="on")
    assert about(baked)["baked"] and not about(everything)["baked"]  # five poses do not pay for it
    for frame in (0, 1):
        ours, theirs = filmed(baked, frame), filmed(everything, frame)
        assert float((ours[0].means - theirs[0].means).abs().max()) < 2e-3
        assert float((render(ours[0], ours[1]).color - render(theirs[0], ours[1]).color).abs().mean()) < 5e-3


def test_the_body_is_where_the_motion_says(everything):
    """The splats lie on the fitted body posed by the motion, within what the heads move them."""
    body = open_body()
    rotation, way = made_up(COUNT)
    rotation[:, 0] = 0
    placed = way.float() - rest_joints(body, mean_identity(body))[0]
    for frame in (0, COUNT - 1):
        vertices, _ = pose_body(
            body, mean_identity(body), rotation[frame : frame + 1].float(),
            torch.zeros(1, body.expression_directions.shape[2]), placed[frame : frame + 1],
        )  # fmt: skip
        means = filmed(everything, frame)[0].means
        moved = means - vertices[0]
        moved[:, 1] -= moved[:, 1].median()  # the ground
        assert float(moved.norm(dim=1).median()) < 0.02


def test_a_range_without_frames_is_an_error_that_names_the_file(studio, walk):
    with pytest.raises(UserError, match="walk.npz has frames 0 to 4"):
        studio.animate("none", motion=str(walk), first_frame=50)
