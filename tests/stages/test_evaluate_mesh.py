"""A painted body: its textured mesh, and cameras behind it that no training frame had."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.body import write_identity, write_poses
from pipeline.clip.camera import Camera
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.records import write_cameras
from pipeline.metrics import interior, psnr
from pipeline.splat import render
from stages.evaluate.baselines import mean_frame
from stages.evaluate.evaluated_clip import read_evaluated_clip
from stages.evaluate.methods import AVATAR, AvatarMethod
from stages.evaluate.other_cameras import read_true_surface, score_other_cameras
from stages.evaluate.textured_mesh import textured_mesh
from tests.made.body import open_body
from tests.made.portrait import moving_poses, painted_avatar, write_trained


def behind(camera):
    """The camera at the same distance on the other side of the body, upright."""
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))  # about the vertical through the world's origin
    middle = torch.tensor([0.0, 0.0, -0.6])
    rotation = camera.rotation @ turn
    return Camera(camera.width, camera.height, camera.intrinsics, rotation, -rotation @ (2 * middle))


@pytest.fixture(scope="module")
def painted(tmp_path_factory):
    """The body of the train stage's tests, with the truth of its surface and a camera behind it."""
    folder = tmp_path_factory.mktemp("body")
    inputs, avatar, ingest = write_trained(folder), painted_avatar(), folder / "ingest"
    write_poses(ingest / "truth_poses.parquet", moving_poses())
    write_identity(ingest / "truth_surface.safetensors", avatar.identity, open_body())
    clip = read_evaluated_clip(inputs, open_body())
    view = ingest / "views" / "back"
    for name in ("frames", "masks"):
        (view / name).mkdir(parents=True)
    camera = behind(clip.camera(0))
    with torch.no_grad():
        rendering = render(avatar.gaussians(clip.pose(0)), camera)
    write_frame(view / "frames", 0, (rendering.color.clamp(0, 1).numpy() * 255).astype(np.uint8))
    write_mask(view / "masks", 0, (rendering.alpha.clamp(0, 1).numpy() * 255).astype(np.uint8))
    write_cameras(view / "cameras.parquet", {0: camera})
    return clip, avatar


def test_the_textured_mesh_comes_nearer_than_a_still(painted):
    clip, advanced = painted[0], []
    mesh = textured_mesh(clip, clip.split.train[::2], lambda: advanced.append(1))
    assert len(advanced) == 3 and 0.02 < mesh.known < 0.5
    held_out = clip.split.test[0]
    truth, drawn = clip.person(held_out), mesh.render(held_out)("black")
    still = mean_frame(clip.person, clip.split.train)
    inside = interior(clip.mask(held_out))
    assert psnr(drawn, truth, inside) > psnr(still, truth, inside) + 3


def test_what_no_training_frame_shows_is_told_apart(painted):
    clip, avatar = painted
    true = read_true_surface(clip)
    assert 0.05 < true.seen.mean() < 0.6
    # From the front nearly everything is seen, from behind hardly anything.
    front = true.unseen_pixels(clip.camera(0), 0).sum()
    back = true.unseen_pixels(behind(clip.camera(0)), 0).sum()
    assert int(front) < 20 and int(back) > 200

    def wrong_behind(pose, time):
        """The avatar that was filmed, in other colours where no frame showed it."""
        gaussians = avatar.gaussians(pose, time)
        gaussians.colors[~torch.from_numpy(true.seen)] = 0.0
        return gaussians

    methods = [AvatarMethod(AVATAR, clip, animate, ()) for animate in (avatar.gaussians, wrong_behind)]
    right, wrong = (
        {row.metric: row.value for row in score_other_cameras(clip, [method], true, "black")}
        for method in methods
    )
    assert right["psnr_unseen"] > 40 and right["unseen_share"] > 0.5
    assert wrong["psnr_unseen"] < 20 and wrong["psnr"] < right["psnr"] - 10


def test_a_clip_without_truth_has_none(tmp_path, painted):
    bare = dataclasses.replace(painted[0], folder=tmp_path)
    assert read_true_surface(bare) is None
    assert list(score_other_cameras(bare, [], None, "black")) == []
