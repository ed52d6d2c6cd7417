import dataclasses

import numpy as np
import pytest
import roma
import torch

from pipeline.body import Pose
from pipeline.clip.boxes import Box, person_box
from pipeline.clip.camera import project, to_camera
from pipeline.clip.frames import spread_end_to_end
from pipeline.orbit_cameras import Extent, orbit, relaxed_pose, visible_extent
from pipeline.splat import Gaussians
from stages.evaluate.baselines import mean_frame, nearest_frames
from stages.evaluate.report.pictures import compare, comparison_sheet
from stages.evaluate.report.videos import turntable_pictures
from stages.evaluate.scores import TableRow, score_table
from stages.evaluate.statistics import means
from tests.made.blob import stand_in


def flat(value):
    return torch.full((4, 6, 3), value)


def test_mean_frame_by_hand():
    values = {0: 0.1, 4: 0.2, 8: 0.6}
    assert torch.allclose(mean_frame(lambda index: flat(values[index]), (0, 4, 8)), flat(0.3))
    with pytest.raises(ValueError, match="at least one"):
        mean_frame(flat, ())


def test_nearest_frame_by_hand():
    values = {0: 0.1, 1: 0.5, 2: 0.6, 10: 0.53, 11: 0.0, 12: 0.55}
    nearest = nearest_frames(lambda index: flat(values[index]), (0, 1, 2), (10, 11))
    assert nearest == {10: 1, 11: 0}
    same = nearest_frames(lambda index: flat(0.5), (3, 5), tuple(range(100, 170)))
    assert set(same.values()) == {3} and len(same) == 70


def test_means_leave_out_what_is_not_defined():
    rows = [
        ("psnr", 1, 20.0),
        ("psnr", 2, 30.0),
        ("psnr_interior", 1, float("nan")),
        ("psnr_interior", 2, 31.0),
    ]
    table = score_table(TableRow(frame, "test", "avatar", metric, value) for metric, frame, value in rows)
    assert means(table, ["psnr", "psnr_interior", "ssim"]) == {
        "test": {"avatar": {"psnr": 25.0, "psnr_interior": 31.0, "ssim": None}}
    }


def test_evenly_spaced():
    assert spread_end_to_end(range(10), 4) == [0, 3, 6, 9]
    assert spread_end_to_end(range(10), 1) == [5]
    assert spread_end_to_end(range(3), 5) == [0, 1, 2]


def test_the_arms_hang_in_the_relaxed_pose():
    rotation = relaxed_pose(1.0)
    left, right = (roma.rotvec_to_rotmat(rotation[joint]) for joint in (16, 17))
    down = -torch.sin(torch.tensor(1.0))
    assert (left @ torch.tensor([1.0, 0, 0]))[1] == pytest.approx(float(down))
    assert (right @ torch.tensor([-1.0, 0, 0]))[1] == pytest.approx(float(down))
    assert int((rotation != 0).sum()) == 2


def test_extent_counts_only_what_is_seen():
    blob = stand_in(Pose(torch.zeros(55, 3), torch.zeros(4), torch.tensor([1.0, 2.0, 3.0])), None)
    far = dataclasses.replace(blob, means=blob.means + 50, opacities=torch.zeros(40))
    both = Gaussians(*(torch.cat(pair) for pair in zip(blob.tensors(), far.tensors(), strict=True)))
    extent = visible_extent(both)
    assert torch.allclose(extent.centre, torch.tensor([1.0, 2.0, 3.0]), atol=0.1)
    # Means within 0.8 m by 0.6 m by 0.3 m, and two standard deviations of 0.09 m around them.
    assert 0.45 < extent.height.max() < 0.4 + 0.18 + 1e-6 and 0.3 < extent.radius.max() < 0.36 + 0.18
    nothing = visible_extent(dataclasses.replace(blob, opacities=torch.zeros(40)))
    assert float(orbit(nothing, 48, 64, 1)[0].translation[2]) > 1


@pytest.mark.parametrize("extent", [(1.8, 0.3), (0.3, 0.9)], ids=["tall", "wide"])
def test_nothing_is_cut_off_at_any_angle(extent):
    height, radius = extent
    body = Extent(torch.tensor([0.1, 1.0, -0.2]), np.array([radius]), np.array([height / 2]))
    angles = torch.linspace(0, 6.28, 60)
    rim = torch.stack([torch.cos(angles) * radius, torch.zeros(60), torch.sin(angles) * radius], -1)
    ends = torch.tensor([0.0, height / 2, 0.0])
    points = torch.cat([rim + ends, rim - ends]) + body.centre
    largest = 0.0
    for camera in orbit(body, 120, 160, 7):
        pixels = project(camera, points)
        assert (to_camera(camera, points)[:, 2] > 0).all()
        assert (pixels >= 0).all() and (pixels <= torch.tensor([120.0, 160.0])).all()
        spread = pixels.amax(0) - pixels.amin(0)
        largest = max(largest, float((spread / torch.tensor([120.0, 160.0])).max()))
    assert largest > 0.7


def test_the_turn_starts_at_the_face_and_goes_to_the_left_side():
    cameras = orbit(Extent(torch.zeros(3), np.array([0.5]), np.array([0.5])), 120, 160, 4)
    front, left = cameras[0].centre, cameras[1].centre
    assert front[2] > 1 and abs(float(front[0])) < 1e-5
    assert left[0] > 1 and abs(float(left[2])) < 1e-5
    for camera in cameras:
        assert torch.allclose(camera.rotation @ camera.rotation.T, torch.eye(3), atol=1e-6)
        assert float(torch.linalg.det(camera.rotation)) == pytest.approx(1.0)
    # Seen from the front, the subject's left (+X) is on the right of the image, and up is up.
    means = torch.tensor([[0.3, 0.3, 0.0]])
    one = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.05), torch.zeros(1, 3), torch.ones(1)
    )
    dark = next(turntable_pictures(one, cameras[:1])).astype(int).sum(-1)
    row, column = np.unravel_index(dark.argmin(), dark.shape)
    assert row < 80 and column > 60


def test_comparison_by_hand():
    truth, image = torch.zeros(20, 30, 3), torch.zeros(20, 30, 3)
    image[5, 6] = 0.2
    one = compare(4, truth, image, 3.0, 31.0)
    assert one.error[5, 6].tolist() == [153, 153, 153] and one.error.sum() == 3 * 153
    cropped = one.cropped(Box(6, 5, 10, 9))
    assert cropped.render.shape == (4, 4, 3) and cropped.render[0, 0, 0] == 51
    sheet = comparison_sheet([one, one], 3.0)
    assert sheet.shape[1] == 3 * 30 + 2 * 6 and sheet.dtype == np.uint8


def test_the_persons_box():
    mask = np.zeros((50, 60), np.uint8)
    mask[20:30, 5:40] = 255
    assert person_box([mask], margin=8) == Box(0, 12, 48, 38)
    assert person_box([np.zeros((5, 7), np.uint8)]) is None
