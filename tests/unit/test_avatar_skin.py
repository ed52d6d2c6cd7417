"""Skinning weights of moved points: taken from the original vertex that lies nearest."""

import torch

from pipeline.avatar import Architecture, Avatar, load_avatar, save_avatar
from pipeline.avatar.skinning_tables import OWN, nearest_rows
from pipeline.body import Pose, mean_identity

POSE = torch.zeros(55, 3)
POSE[16, 2], POSE[18, 1] = -1.0, -0.7  # the left arm down and bent


def an_avatar(body) -> Avatar:
    """The torso and arms in front, with offsets of some centimetres."""
    kept = torch.nonzero(body.v_template[:, 1] > 0.1)[:, 0]
    sizes = Architecture(plane_resolution=16, plane_channels=4, width=16, subdivisions=1, offset_unit=0.2)
    avatar = Avatar(body, mean_identity(body), kept, sizes, half_precision=False)
    generator = torch.Generator().manual_seed(3)
    avatar.representation.geometry.last.weight.data = 0.1 * torch.randn(6, 16, generator=generator)
    return avatar.eval()


def test_nearest_rows_by_hand():
    original = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    points = torch.tensor([[0.1, 0.0, 0.0], [0.9, 0.3, 0.0], [0.9, 0.0, 0.0]])
    rows = nearest_rows(points, original, torch.tensor([True, True, False]))
    assert rows.tolist() == [0, 1, OWN]


def test_reskinned_points_have_the_weights_of_the_nearest_vertex(body):
    avatar = an_avatar(body)
    before, decoded = avatar.surfaces[-1].canonical.skinning_weights, avatar.decode()
    taken = avatar.surfaces[0].canonical.skinning_weights
    with torch.no_grad():
        avatar.reskin()
    points = decoded.surface.canonical.vertices + decoded.offset.detach()
    original, after = avatar.surfaces[0].canonical, avatar.surfaces[-1].canonical.skinning_weights
    still = decoded.surface.pose_movable[:, 0] == 0
    assert bool(still.any()) and torch.equal(after[still], before[still])  # head and hands
    moved = torch.nonzero(~still)[::97, 0]
    nearest = torch.cdist(points[moved], original.vertices).argmin(1)
    torch.testing.assert_close(after[moved], taken[nearest], rtol=0, atol=0)
    assert not torch.equal(after, before)


def test_avatar_reads_back_with_its_weights(body, tmp_path):
    avatar = an_avatar(body)
    rest = Pose(
        POSE, torch.zeros(avatar.surfaces[0].canonical.expression_directions.shape[2]), torch.zeros(3)
    )
    with torch.no_grad():
        plain = avatar.gaussians(rest)
        avatar.reskin()
        skinned = avatar.gaussians(rest)
    save_avatar(tmp_path / "avatar.safetensors", avatar)
    with torch.no_grad():
        again = load_avatar(tmp_path / "avatar.safetensors", body).gaussians(rest)
    assert not torch.equal(plain.means, skinned.means)
    assert torch.equal(again.means, skinned.means) and torch.equal(again.quaternions, skinned.quaternions)
