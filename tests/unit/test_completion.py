"""Completion: what no frame showed is taken from what frames did, hair from hair and cloth from cloth."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pipeline.avatar import Architecture, Avatar, load_avatar, save_avatar
from pipeline.avatar.bake import bake
from pipeline.avatar.color_bounds import ANYWHERE
from pipeline.avatar.completion import calm_colors, complete_avatar
from pipeline.avatar.evidence import Evidence, covering_log_scale
from pipeline.avatar.holes import around_holes
from pipeline.avatar.representation import Decoded
from pipeline.body import Pose, load_body, mean_identity, part_labels, rest_joints
from pipeline.clip.camera import facing_camera
from pipeline.clip.views import View
from pipeline.orbit_cameras import relaxed_pose
from pipeline.splat import Gaussians
from pipeline.texture.completion import complete_colors, complete_log_scales
from pipeline.texture.segments import BODY, FACE, LEFT_HAND, NECK, RIGHT_HAND, SCALP, find_segments

SKIN, HAIR, CLOTH = np.array([0.8, 0.6, 0.5]), np.array([0.12, 0.08, 0.06]), np.array([0.1, 0.3, 0.7])
BODY_MODEL = load_body(Path(__file__).parents[2] / "data" / "body" / "open_body.npz")


@pytest.fixture(scope="module")
def segments():
    body = BODY_MODEL
    joints = rest_joints(body, mean_identity(body))
    return find_segments(body.v_template, body.faces, body.skinning_weights, part_labels(body), joints)


@pytest.fixture(scope="module")
def front(segments):
    """Trust of a body that is filmed from the front: 1 where it faces +Z."""
    return np.clip(4 * segments.normals[:, 2], 0, 1)


def painted(segments):
    color = np.tile(CLOTH, (len(segments), 1))
    color[segments.is_in(FACE, NECK, LEFT_HAND, RIGHT_HAND)] = SKIN
    color[segments.is_in(SCALP)] = HAIR
    return color


def spoiled(color, trust):
    """Nonsense where nothing is known."""
    return np.where(trust[:, None] > 0, color, np.random.default_rng(0).random(color.shape))


def away_from_hairline(segments):
    """[N] bool: not on the head within 4 cm of where scalp meets skin; hair passes into skin there."""
    points, head = BODY_MODEL.v_template.numpy(), segments.is_in(FACE, SCALP, NECK)
    seam = segments.seams[segments.is_in(SCALP)[segments.seams].any(1)]
    return ~head | (cKDTree(points[seam.ravel()]).query(points)[0] > 0.04)


def test_segments_are_where_they_should_be(segments):
    y, z = BODY_MODEL.v_template[:, 1].numpy(), BODY_MODEL.v_template[:, 2].numpy()
    scalp, face = segments.is_in(SCALP), segments.is_in(FACE)
    assert scalp[z.argmin() if y[z.argmin()] > y[face].min() else y.argmax()] and scalp[y.argmax()]
    assert z[face].mean() > z[scalp].mean() + 0.05
    assert (segments.label[segments.mirrored[segments.is_in(LEFT_HAND)]] == RIGHT_HAND).mean() > 0.99
    assert (segments.label[segments.edges[:, 0]] == segments.label[segments.edges[:, 1]]).all()


def test_the_back_is_as_the_front_each_segment_its_own(segments, front):
    color = painted(segments)
    found = complete_colors(segments, spoiled(color, front), front)
    assert np.abs(found - color)[away_from_hairline(segments)].max() < 0.02
    head = segments.is_in(FACE, SCALP, NECK)
    assert (found[head] >= HAIR - 0.02).all() and (found[head] <= SKIN + 0.02).all()


def test_the_hairline_behind_is_soft(segments, front):
    """What a segment's border gives is a straight line, and nobody has one."""
    color = painted(segments)
    found = complete_colors(segments, spoiled(color, front), front)[:, 0]
    seam = segments.seams[segments.is_in(SCALP, NECK)[segments.seams].all(1)]
    steps = np.abs(found[seam[:, 0]] - found[seam[:, 1]])[(segments.normals[seam, 2] < -0.5).all(1)]
    assert len(steps) > 10 and np.median(steps) < 0.6 * abs(SKIN - HAIR)[0]


def test_the_wall_beside_a_silhouette_is_outvoted(segments, front):
    """A few vertices beside what no frame shows have another colour, as fits that are a little off give."""
    color, trunk = painted(segments), segments.is_in(BODY) & (segments.part == 0)
    rim = trunk & (front > 0) & (front < 1)
    wrong = rim & (np.random.default_rng(3).random(len(segments)) < 0.15)
    color[wrong] = [0.9, 0.9, 0.7]
    found = complete_colors(segments, spoiled(color, front), front, telling=front)
    behind = trunk & (front == 0)
    assert np.quantile(np.abs(found[behind] - CLOTH).max(1), 0.95) < 0.08


def test_hair_on_the_face_s_segment_is_completed_as_hair(segments, front):
    """The face reaches to the ears and over the hairline; what is hair there is told by its colour."""
    color, points = painted(segments), BODY_MODEL.v_template.numpy()
    low = segments.is_in(FACE) & (points[:, 1] > np.quantile(points[segments.is_in(FACE), 1], 0.85))
    color[low] = HAIR
    trust = np.where(low & (np.random.default_rng(2).random(len(segments)) < 0.5), 0.0, front)
    found = complete_colors(segments, spoiled(color, trust), trust)
    inside = low & (trust == 0) & (front == 1)
    assert inside.sum() > 20 and np.quantile(np.abs(found[inside] - HAIR).max(1), 0.7) < 0.1


def test_the_forehead_does_not_spread_over_the_back_of_the_head(segments, front):
    """The hairline lies higher than the scalp begins: its lower front is skin."""
    color, scalp = painted(segments), segments.is_in(SCALP)
    height = BODY_MODEL.v_template[:, 1].numpy()
    low = scalp & (front > 0) & (height < np.quantile(height[scalp & (front > 0)], 0.4))
    color[low] = SKIN
    found = complete_colors(segments, spoiled(color, front), front)
    behind = scalp & (segments.normals[:, 2] < -0.5) & away_from_hairline(segments)
    assert np.abs(found[behind] - HAIR).max() < 0.05
    np.testing.assert_array_equal(found[low & (front == 1)], color[low & (front == 1)])


def test_garments_end_behind_where_they_end_in_front(segments, front):
    color, height = painted(segments), segments.along
    trunk = segments.is_in(BODY) & (segments.part == 0)
    above = trunk & (height > np.median(height[trunk]))
    color[above] = [0.9, 0.9, 0.1]
    found = complete_colors(segments, spoiled(color, front), front)
    behind = trunk & (segments.normals[:, 2] < -0.7) & (np.abs(height - np.median(height[trunk])) > 0.04)
    assert np.abs(found[behind] - color[behind]).max() < 0.08


def test_the_unseen_side_is_the_seen_sides_mirror_image(segments):
    color = painted(segments)
    left = BODY_MODEL.v_template[:, 0].numpy() > 0
    spot = segments.is_in(BODY) & (np.abs(BODY_MODEL.v_template[:, 0].numpy()) > 0.35)
    color[spot] = [0.9, 0.1, 0.1]
    trust = np.where(left, 1.0, 0.0)
    found = complete_colors(segments, spoiled(color, trust), trust)
    far = ~left & (np.abs(BODY_MODEL.v_template[:, 0].numpy()) > 0.05)
    assert np.quantile(np.abs(found - color)[far].max(1), 0.99) < 0.1


@pytest.mark.parametrize("known", [(), (SCALP,), (FACE,), (BODY,), (LEFT_HAND,)])
def test_a_part_without_evidence_has_a_colour_all_the_same(segments, known):
    color = painted(segments)
    trust = segments.is_in(*known).astype(float)
    found = complete_colors(segments, spoiled(color, trust), trust, segments.normals)
    assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1
    if known == (FACE,):
        assert np.abs(found[segments.is_in(LEFT_HAND, NECK)] - SKIN).max() < 0.05


def test_what_is_wholly_trusted_stays_to_the_byte(segments):
    values, trust = np.random.default_rng(1).random((len(segments), 3)), np.ones(len(segments))
    for complete in (complete_colors, complete_log_scales):
        np.testing.assert_array_equal(complete(segments, values, trust), values)


def test_guessed_scales_cover(segments, front):
    scales = complete_log_scales(segments, np.full((len(segments), 3), -2.0), front)
    assert (np.median(scales[segments.normals[:, 2] < -0.9]) > -0.3) and (scales[front == 1] == -2).all()


def test_guessed_scales_are_as_large_as_is_asked(segments, front):
    scales = complete_log_scales(segments, np.zeros((len(segments), 3)), front, covers=0.3)
    assert np.median(scales[segments.normals[:, 2] < -0.9]) > 0.25 and (scales[front == 1] == 0).all()


@pytest.mark.parametrize("scale", [0.3, 0.55, 0.75, 0.9])
def test_no_light_passes_between_four_neighbours_that_cover(scale):
    """On a square grid a cell's middle is the farthest from its corners."""
    width = scale * np.exp(covering_log_scale(scale))
    assert (1 - np.exp(-0.5 * (np.sqrt(0.5) / width) ** 2)) ** 4 < 0.02


def test_a_jacket_s_back_is_like_its_sides_and_not_like_the_shirt_in_front(segments, front):
    color, trunk = painted(segments), segments.is_in(BODY) & (segments.part == 0)
    shirt = trunk & (np.abs(segments.around) < 0.6)
    color[shirt] = [0.95, 0.95, 0.95]
    found = complete_colors(segments, spoiled(color, front), front)
    behind = trunk & (segments.normals[:, 2] < -0.7)
    assert np.quantile(np.abs(found[behind] - CLOTH).max(1), 0.95) < 0.1


def trained(representation: str) -> Avatar:
    """A small avatar with random parameters."""
    sizes = Architecture(
        plane_resolution=4, plane_channels=2, width=16, groups=4, subdivisions=0, residual_parts=(),
        representation=representation, bases=2,
    )  # fmt: skip
    avatar = Avatar(BODY_MODEL, mean_identity(BODY_MODEL), torch.arange(len(BODY_MODEL.v_template)), sizes)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for one in avatar.parameters():
            one.copy_((0.1 * torch.randn(one.shape, generator=generator)).half())
        if representation == "bases":
            avatar.representation.signal_components.normal_(0, 0.1, generator=generator)
            avatar.representation.signal_limits.copy_(torch.tensor([[-9.0], [9.0]]).expand(2, 2))
    return avatar.eval()


def seen_from_behind_only(segments):
    return np.clip(-4 * segments.normals[:, 2], 0, 1)


def test_a_body_seen_from_behind_alone_has_a_face_of_skin_and_cloth_in_front(segments):
    color, trust = painted(segments), seen_from_behind_only(segments)
    found = complete_colors(segments, spoiled(color, trust), trust, segments.normals)
    before = segments.normals[:, 2] > 0.7
    for label, like, other in ((FACE, SKIN, HAIR), (BODY, CLOTH, SKIN)):
        guessed = found[before & segments.is_in(label)].mean(0)
        assert np.abs(guessed - like).max() < np.abs(guessed - other).max() / 2


def evidence(trust: torch.Tensor) -> Evidence:
    """Evidence of which trust is 0 or 1, as given."""
    count = len(trust)
    return Evidence(trust, trust, trust, trust, trust, torch.rand(count, 3), torch.zeros(count, 3))


def test_what_frames_saw_from_its_edge_alone_stays_near_its_segments_color(segments):
    avatar = trained("bases")
    trust = torch.from_numpy(np.clip(4 * segments.normals[:, 2], 0, 1)).float()
    shown = dataclasses.replace(evidence(trust), square=trust)
    decoded, patch = avatar.decode(), segments.is_in(FACE, BODY) & (segments.normals[:, 2] < -0.1)
    colors = torch.from_numpy(painted(segments)).float()
    colors[torch.from_numpy(patch)] = torch.tensor([0.9, 0.2, 0.6])  # what stood behind the person's rim
    bounds = calm_colors(dataclasses.replace(decoded, color_logit=torch.logit(colors)), shown)
    base = avatar.base_color
    square, hair = trust > 0.7, torch.from_numpy(segments.is_in(SCALP) & away_from_hairline(segments))
    assert bounds.around[square].min() == ANYWHERE and bool(bounds.hair[hair].all())
    with torch.no_grad():
        avatar.representation.color.copy_(torch.logit(colors) - base)
        avatar.representation.hold_colors(bounds, base)
    found = torch.sigmoid(base + avatar.representation.color).detach()
    torch.testing.assert_close(found[square], colors[square], rtol=0, atol=1e-6)
    for label, like, near in ((FACE, SKIN, 0.04), (BODY, CLOTH, 0.12)):
        rows = patch & segments.is_in(label)
        assert np.quantile(np.abs(found.numpy()[rows] - like).max(1), 0.9) < near


@pytest.mark.parametrize("representation", ["bases", "triplane"])
def test_an_avatar_of_which_all_was_seen_stays_to_the_byte(representation, tmp_path):
    avatar = trained(representation)
    save_avatar(tmp_path / "before", avatar)
    complete_avatar(avatar, evidence(torch.ones(len(avatar))))
    save_avatar(tmp_path / "after", avatar)
    assert (tmp_path / "before").read_bytes() == (tmp_path / "after").read_bytes()


@pytest.mark.parametrize("representation", ["bases", "triplane"])
def test_a_completed_avatar_is_stored_and_baked_as_it_is(representation, tmp_path):
    avatar = trained(representation)
    trust = (avatar.surfaces[-1].canonical.frames[:, 2, 2] > 0).float()
    complete_avatar(avatar, evidence(trust))
    pose = Pose(0.1 * torch.randn(55, 3), torch.zeros(10), torch.tensor([0.0, 0, -3]))
    with torch.no_grad():
        here = avatar.gaussians(pose)
        save_avatar(tmp_path / "avatar", avatar)
        there = load_avatar(tmp_path / "avatar", BODY_MODEL)
        again, baked = there.gaussians(pose), bake(there).gaussians(pose)
    torch.testing.assert_close(there.trust, avatar.trust)
    for one, two, three in zip(here.tensors(), again.tensors(), baked.tensors(), strict=True):
        torch.testing.assert_close(one, two, atol=2e-3, rtol=2e-3)
        torch.testing.assert_close(two, three, atol=1e-2, rtol=1e-2)


@pytest.mark.parametrize("representation", ["bases", "triplane"])
def test_what_was_not_seen_does_not_follow_the_pose(representation):
    avatar = trained(representation)
    avatar.pose_heads_active = True
    unseen = avatar.surfaces[-1].canonical.frames[:, 2, 2] < 0
    complete_avatar(avatar, evidence((~unseen).float()))
    poses = [Pose(turn * torch.ones(55, 3), torch.zeros(10), torch.zeros(3)) for turn in (0.0, 0.3)]
    with torch.no_grad():
        colors = [avatar.gaussians(pose).colors for pose in poses]
    torch.testing.assert_close(colors[0][unseen], colors[1][unseen], atol=1e-6, rtol=0)
    assert not torch.allclose(colors[0][~unseen], colors[1][~unseen], atol=1e-4)


@pytest.mark.parametrize("spoils", [False, True], ids=["unasked", "in frames that show nothing there"])
@pytest.mark.parametrize("representation", ["bases", "triplane"])
def test_a_sieve_is_closed_though_it_was_seen(representation, spoils):
    avatar = trained(representation)
    decoded = avatar.decode()
    chest = (decoded.surface.canonical.parts == 0) & (decoded.surface.canonical.frames[:, 2, 2] > 0)
    shrunk = decoded.log_scale.clone().clamp_min(0)
    shrunk[chest] = -2.0
    everything = torch.arange(len(avatar.trust))
    avatar.trust[:] = 0.999
    avatar.take_completion(everything, dataclasses.replace(decoded, log_scale=shrunk))
    pose = Pose(relaxed_pose(1.0), torch.zeros(10), torch.zeros(3))

    def sieve() -> int:
        with torch.no_grad():
            return int((around_holes(avatar.gaussians(pose), decoded.surface.canonical.faces) & chest).sum())

    before, trust = sieve(), torch.ones(len(avatar))
    trust[-1] = 0  # something is to be completed
    complete_avatar(avatar, evidence(trust), (lambda one: empty_frames(avatar, one)) if spoils else None)
    assert before > 100 and sieve() < before / 5


def empty_frames(avatar: Avatar, decoded: Decoded) -> list[tuple[Gaussians, View]]:
    """Two frames that show nobody where the avatar stands, as where a desk hides a lap."""
    camera = facing_camera(120, 90, 100.0)
    pose = Pose(torch.zeros(55, 3), torch.zeros(10), torch.tensor([0.0, 0.0, -2.0]))
    view = View(torch.zeros(90, 120, 3), torch.zeros(90, 120), camera)
    return [(avatar.pose(decoded, pose).gaussians, view)] * 2
