"""The avatar: its canonical mesh, how gradients run, and its file."""

import dataclasses
import json
import math

import pytest
import safetensors
import torch
from safetensors.torch import save_file

from pipeline.avatar import Architecture, Avatar, build_canonical, load_avatar, pose_features, save_avatar
from pipeline.avatar.canonical import dilate, tangent_frames, tangent_spacing
from pipeline.body import Identity, Pose, mean_identity, posed_vertices, rasterize, vertex_normals
from pipeline.clip.camera import facing_camera
from pipeline.errors import UserError
from pipeline.splat import render

SMALL = Architecture(plane_resolution=8, plane_channels=2, width=8, groups=2, subdivisions=1)


@pytest.fixture(scope="module")
def identity(body):
    generator = torch.Generator().manual_seed(0)
    mean = mean_identity(body)
    return Identity(
        betas=torch.randn(10, generator=generator),
        joint_offset=0.002 * torch.randn(55, 3, generator=generator),
        face_offset=mean.face_offset,
    )


@pytest.fixture(scope="module")
def kept(body):
    """Head, shoulders and some torso."""
    return torch.nonzero(body.v_template[:, 1] > 0.1)[:, 0]


@pytest.fixture
def avatar(body, identity, kept):
    return Avatar(body, identity, kept, SMALL, seed=3)


def a_pose(expressions: int = 5):
    generator = torch.Generator().manual_seed(1)
    rotation = 0.2 * torch.randn(55, 3, generator=generator)
    expression = torch.randn(expressions, generator=generator)
    return Pose(rotation, expression, torch.tensor([0.1, -0.3, -1.5]))


def awakened(avatar: Avatar) -> Avatar:
    """Last layers away from zero, so that every head has a say."""
    generator = torch.Generator().manual_seed(5)
    for parameter in avatar.parameters():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    return avatar


@pytest.mark.parametrize("degrees", [0, 90, 180])
def test_the_silhouette_of_an_inset_avatar_is_nearer_to_the_bodys(body, degrees):
    identity, turned = mean_identity(body), torch.zeros(55, 3)
    turned[0, 1] = math.radians(degrees)
    pose = Pose(turned, torch.zeros(5), torch.tensor([0.0, 0.3, -4.0]))
    camera = facing_camera(200, 200, focal=400.0)
    body_covers = rasterize(camera, posed_vertices(body, identity, pose), body.faces).covered.sum()

    def too_much(inset: float) -> float:
        architecture = dataclasses.replace(SMALL, subdivisions=0, inset=inset)
        avatar = Avatar(body, identity, torch.arange(len(body.v_template)), architecture)
        with torch.no_grad():
            return float(render(avatar.eval().gaussians(pose), camera).alpha.sum()) / body_covers - 1

    assert too_much(0.0) > 0.1 and abs(too_much(0.7)) < 0.6 * too_much(0.0)


def test_untrained_avatar_is_the_fitted_body(body, identity, avatar, kept):
    gaussians = avatar.eval().gaussians(a_pose())
    vertices = posed_vertices(body, identity, a_pose())
    torch.testing.assert_close(gaussians.means[: len(kept)], vertices[kept], rtol=1e-4, atol=1e-5)
    assert torch.equal(gaussians.colors, torch.full_like(gaussians.colors, 0.5))


def test_gaussians_lie_flat_on_the_posed_surface(body, identity):
    everything = torch.arange(len(body.v_template))
    avatar = Avatar(body, identity, everything, dataclasses.replace(SMALL, subdivisions=0)).eval()
    pose = a_pose()
    pose.rotation[20:] = 0  # wild fingers fold the mesh, where a normal means little
    gaussians = avatar.gaussians(dataclasses.replace(pose, expression=0 * pose.expression))
    w, x, y, z = gaussians.quaternions.unbind(1)
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    normals = vertex_normals(gaussians.means, body.faces)
    assert (axis * normals).sum(1).median() > 0.99
    torch.testing.assert_close(gaussians.scales[:, 2], 0.5 * gaussians.scales[:, :2].mean(1))


def test_subdivided_levels_share_their_first_vertices(body, identity, kept):
    meshes = [build_canonical(body, identity, level, kept) for level in (0, 1)]
    count = len(meshes[0])
    assert len(meshes[1]) > 3.5 * count
    assert torch.equal(meshes[1].vertices[:count], meshes[0].vertices)
    assert torch.equal(meshes[1].parts[:count], meshes[0].parts)
    torch.testing.assert_close(meshes[1].skinning_weights.sum(1), torch.ones(len(meshes[1])))
    ratio = meshes[1].spacing[:count] / meshes[0].spacing
    assert 0.45 < float(ratio.median()) < 0.55


def test_spacing_is_the_edge_length_of_regular_triangles_and_follows_stretch():
    angles = torch.arange(6) * torch.pi / 3
    ring = torch.stack([angles.cos(), angles.sin(), torch.zeros(6)], 1)
    vertices = torch.cat([torch.zeros(1, 3), 0.01 * ring])
    faces = torch.tensor([[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)])
    frames = torch.eye(3).expand(7, 3, 3)
    torch.testing.assert_close(tangent_spacing(vertices, faces, frames)[0], torch.tensor([0.01, 0.01]))
    stretched = vertices * torch.tensor([3.0, 1.0, 1.0])
    torch.testing.assert_close(tangent_spacing(stretched, faces, frames)[0], torch.tensor([0.03, 0.01]))


def test_canonical_refuses_a_foreign_vertex(body, identity):
    with pytest.raises(ValueError, match="kept vertices"):
        build_canonical(body, identity, 0, torch.tensor([len(body.v_template)]))


def test_tangent_frames_are_rotations_everywhere():
    normals = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    normals = torch.nn.functional.normalize(torch.cat([normals, torch.eye(3), -torch.eye(3)]), dim=1)
    frames = tangent_frames(normals)
    torch.testing.assert_close(frames.mT @ frames, torch.eye(3).expand(len(normals), 3, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(len(normals)))
    assert torch.equal(frames[..., 2], normals)


def test_dilation_adds_rings():
    strip = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [4, 5, 6]])
    seed = torch.zeros(7, dtype=torch.bool)
    seed[0] = True
    assert dilate(seed, strip, 0).sum() == 1
    assert dilate(seed, strip, 1).tolist() == [True, True, True, False, False, False, False]
    assert dilate(seed, strip, 2).sum() == 5


def test_pose_features_leave_out_the_root_and_vanish_at_rest():
    rotation = torch.zeros(55, 3)
    rotation[0] = 1.0
    assert torch.equal(pose_features(rotation), torch.zeros(54 * 6))
    rotation[3, 0] = 0.1
    assert torch.nonzero(pose_features(rotation)).flatten().tolist() == [2 * 6 + 3, 2 * 6 + 5]


def gradients(avatar: Avatar, pose_heads: bool) -> dict[str, float]:
    avatar.train()
    avatar.pose_heads_active = pose_heads
    avatar.zero_grad(set_to_none=True)
    gaussians = avatar.pose(avatar.decode(), a_pose()).gaussians
    camera = facing_camera(48, 64, 70.0)
    rendering = render(gaussians, camera)
    (rendering.color.square().sum() + rendering.alpha.sum()).backward()
    return {
        name: 0.0 if parameter.grad is None else float(parameter.grad.abs().max())
        for name, parameter in avatar.named_parameters()
    }


def test_gradients_reach_static_heads_always_and_pose_heads_when_active(avatar):
    awakened(avatar)
    without, active = gradients(avatar, False), gradients(avatar, True)
    for name in without:
        if name.startswith("representation.pose_"):
            assert without[name] == 0, name
        else:
            assert without[name] > 0, name
        assert active[name] > 0, name


def test_texels_that_only_gated_vertices_would_read_get_no_gradient(body, identity, avatar):
    awakened(avatar)
    gradients(avatar, True)
    touched = avatar.representation.triplane.planes.grad.abs().sum(-1).flatten() > 0
    read = torch.zeros(len(touched), dtype=torch.bool)
    read[avatar.surfaces[-1].samples.matrix.col_indices()] = True
    assert touched.any() and not (touched & ~read).any()
    assert len(avatar) == len(avatar.surfaces[-1].canonical)  # no Gaussian beside the kept ones


def test_gradient_reaches_the_pose(avatar):
    awakened(avatar)
    avatar.eval()
    pose = a_pose()
    inputs = [tensor.requires_grad_() for tensor in vars(pose).values()]
    avatar.gaussians(pose).means.square().sum().backward()
    assert all(float(tensor.grad.abs().max()) > 0 for tensor in inputs)


def test_head_and_hands_are_not_moved_by_pose_heads(body, identity):
    everything = torch.arange(len(body.v_template))
    avatar = awakened(Avatar(body, identity, everything, SMALL))
    moved = avatar.pose(avatar.decode(), a_pose()).pose_offset.abs().sum(1)
    canonical = avatar.surfaces[-1].canonical
    still = canonical.is_part("head", "face", "left_hand", "right_hand")
    assert moved[still].max() == 0
    assert moved[~still].min() > 0


def test_noise_reaches_the_pose_heads_alone(avatar):
    awakened(avatar)
    decoded, noise = avatar.decode(), 0.3 * torch.ones(54 * 6)
    plain, noisy = avatar.pose(decoded, a_pose()), avatar.pose(decoded, a_pose(), noise)
    assert not torch.equal(plain.color_logit, noisy.color_logit)
    avatar.pose_heads_active = False
    plain, noisy = avatar.pose(decoded, a_pose()), avatar.pose(decoded, a_pose(), noise)
    assert torch.equal(plain.gaussians.means, noisy.gaussians.means)
    assert torch.equal(plain.color_logit, noisy.color_logit)


def test_only_the_head_kept_needs_one_region(body, identity, avatar):
    head = build_canonical(body, identity, 0).is_part("head", "face")
    alone = Avatar(body, identity, torch.nonzero(head)[:, 0], dataclasses.replace(SMALL, subdivisions=0))
    assert len(alone.boxes) == 1
    assert len(avatar.boxes) == 2


def test_saved_avatar_renders_the_same(tmp_path, body, avatar):
    awakened(avatar).eval()
    path = tmp_path / "avatar.safetensors"
    save_avatar(path, avatar)
    again = load_avatar(path, body)
    for mine, theirs in zip(
        avatar.gaussians(a_pose()).tensors(), again.gaussians(a_pose()).tensors(), strict=True
    ):
        assert torch.equal(mine, theirs)
    second = tmp_path / "again.safetensors"
    save_avatar(second, again)
    assert path.read_bytes() == second.read_bytes()


def test_avatar_in_training_forgets_what_it_decoded(avatar):
    before = avatar.eval().gaussians(a_pose())
    awakened(avatar.train()).eval()
    assert not torch.equal(before.means, avatar.gaussians(a_pose()).means)


def test_avatar_is_not_saved_with_a_number_that_is_not_finite(tmp_path, avatar):
    avatar.representation.color.last.bias.data[1] = float("nan")
    with pytest.raises(ValueError, match="color.last.bias"):
        save_avatar(tmp_path / "avatar.safetensors", avatar)
    assert not list(tmp_path.iterdir())


def rewritten(path, change):
    """The avatar's file with its header changed."""
    with safetensors.safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        header = change(json.loads(file.metadata()["avatar"]), tensors)
    save_file(tensors, path, {"avatar": json.dumps(header)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header, tensors: {**header, "format": "another"}, "not an avatar"),
        (lambda header, tensors: {**header, "body": "0" * 64}, "another body model"),
        (lambda header, tensors: tensors.pop("network.color.last.bias") is None or header, "description"),
    ],
)
def test_wrong_avatar_file_says_what_to_do(tmp_path, body, avatar, change, message):
    path = tmp_path / "avatar.safetensors"
    save_avatar(path, avatar)
    rewritten(path, change)
    with pytest.raises(UserError, match=message) as caught:
        load_avatar(path, body)
    assert "train" in str(caught.value) and str(path) in str(caught.value)


def test_damaged_or_missing_avatar_file_says_what_to_do(tmp_path, body, avatar):
    path = tmp_path / "avatar.safetensors"
    with pytest.raises(UserError, match="run the train stage"):
        load_avatar(path, body)
    save_avatar(path, avatar)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(UserError, match="run the train stage"):
        load_avatar(path, body)
