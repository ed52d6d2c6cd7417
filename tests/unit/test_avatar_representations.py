"""The contract that every representation keeps, and what linear bases promise beyond it."""

import pytest
import safetensors
import torch

from pipeline.avatar import Architecture, Avatar, ClipConditions, load_avatar, pose_features, save_avatar
from pipeline.avatar.bake import bake
from pipeline.avatar.canonical import build_canonical
from pipeline.avatar.representation import Condition
from pipeline.body import Pose, edges, mean_identity
from pipeline.body.edge_splits import split_edges
from pipeline.finite import NotFiniteError

K, FRAMES = 3, 8
KINDS = ("triplane", "bases", "split bases")


def a_pose(seed: int = 1, size: float = 0.2) -> Pose:
    generator = torch.Generator().manual_seed(seed)
    rotation = size * torch.randn(55, 3, generator=generator)
    expression = 5 * size * torch.randn(5, generator=generator)
    return Pose(rotation, expression, torch.tensor([0.1, -0.3, -1.5]))


def conditions() -> ClipConditions:
    poses = [a_pose(seed) for seed in range(FRAMES)]
    return ClipConditions(
        torch.stack([pose_features(pose.rotation) for pose in poses]),
        torch.stack([pose.expression for pose in poses]),
        (0.0, 2.0),
    )


def an_avatar(body, kind: str, awake: bool = True, bases: int = K) -> Avatar:
    """All but one of the bases of "split bases" are bends, to either side."""
    split, kind = kind.startswith("split"), kind.removeprefix("split ")
    sizes = Architecture(
        plane_resolution=8, plane_channels=2, width=8, groups=2, residual_width=8, residual_parts=("face",),
        subdivisions=1, representation=kind, bases=bases if kind == "bases" else 0,
        bends=bases - 1 if split else 0,
    )  # fmt: skip
    kept = torch.nonzero(body.v_template[:, 1] > 0.32)[:, 0]
    splits = some_splits(body, kept) if split else ()
    avatar = Avatar(body, mean_identity(body), kept, sizes, half_precision=False, splits=splits)
    if kind == "triplane" or bases:
        avatar.representation.set_clip(conditions())
    generator = torch.Generator().manual_seed(5)
    for parameter in avatar.parameters() if awake else ():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    return avatar


def some_splits(body, kept: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Every third edge, then every fifth of what that makes."""
    faces = build_canonical(body, mean_identity(body), 0, kept).faces
    first = edges(faces)[::3]
    return first, edges(split_edges(faces, first)[0])[::5]


@pytest.fixture(params=KINDS)
def avatar(request, body):
    return an_avatar(body, request.param)


def half_gated(avatar: Avatar) -> torch.Tensor:
    return torch.arange(len(avatar.vertex_ids)) % 7 != 0


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("level", [0, -1])
def test_decoded_and_posed_have_a_row_a_gaussian(avatar, level, gated):
    if gated:
        avatar.gate(half_gated(avatar))
    decoded = avatar.decode(level)
    count = len(avatar.surface(level).canonical)
    assert count > 0 and len(decoded.features) >= count
    for values in (decoded.offset, decoded.log_scale, decoded.color_logit):
        assert values.shape == (count, 3) and values.dtype == torch.float32
    posed = avatar.pose(decoded, a_pose(), time=1.0)
    assert posed.pose_offset.shape == posed.log_scale.shape == posed.color_logit.shape == (count, 3)
    assert all(len(values) == count for values in posed.gaussians.tensors())


def test_gradients_reach_every_parameter_and_none_outside_the_gate(avatar):
    avatar.train().gate(half_gated(avatar))
    posed = avatar.pose(avatar.decode(), a_pose(), time=1.0)
    (sum(one.square().sum() for one in posed.gaussians.tensors()) + posed.pose_offset.sum()).backward()
    for name, parameter in avatar.named_parameters():
        assert parameter.grad is not None and bool((parameter.grad != 0).any()), name
    if avatar.architecture.representation == "bases":
        outside = torch.ones(len(avatar.base_color), dtype=torch.bool)
        outside[avatar.surface().rows] = False
        assert outside.any()
        for parameter in avatar.parameters():
            assert bool((parameter.grad[outside] == 0).all())


def test_every_parameter_has_one_learning_rate(avatar):
    grouped = [one for group in avatar.representation.parameter_groups().values() for one in group]
    assert sorted(map(id, grouped)) == sorted(map(id, avatar.parameters()))


def test_rows_not_asked_for_do_not_change(avatar):
    decoded, rows = avatar.decode(), torch.arange(1, 600, 3)
    others = torch.ones(len(avatar), dtype=torch.bool).index_fill(0, rows, False)
    with torch.no_grad():
        some, whole = (avatar.pose(decoded, a_pose(), rows=asked) for asked in (rows, None))
    assert bool((some.pose_offset[others] == 0).all())
    torch.testing.assert_close(some.color_logit[rows], whole.color_logit[rows], rtol=1e-4, atol=1e-5)


def test_untrained_avatar_is_the_fitted_body_in_its_base_colours(avatar, body):
    fresh = an_avatar(body, avatar.architecture.representation, awake=False).eval()
    shown = fresh.gaussians(a_pose())
    bare = fresh.base_gaussians(fresh.surface(), a_pose())
    for mine, theirs in zip(shown.tensors(), bare.tensors(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)


def test_baked_avatar_shows_the_same(avatar):
    avatar.eval().gate(half_gated(avatar))
    baked = bake(avatar)
    for active in (True, False):
        avatar.pose_heads_active = active
        with torch.no_grad():
            expected = avatar.gaussians(a_pose(9), 1.0).tensors()
        for mine, theirs in zip(bake(avatar).gaussians(a_pose(9), 1.0).tensors(), expected, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)
    # Of a head only colours follow the pose.
    assert not torch.equal(baked.gaussians(a_pose(9)).colors, bake(avatar).gaussians(a_pose(9)).colors)


def test_saved_avatar_shows_the_same_and_saves_the_same_bytes(tmp_path, avatar, body):
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    save_avatar(first, avatar.eval())
    again = load_avatar(first, body)
    assert again.architecture == avatar.architecture
    for mine, theirs in zip(
        again.gaussians(a_pose()).tensors(), avatar.gaussians(a_pose()).tensors(), strict=True
    ):
        torch.testing.assert_close(mine, theirs, rtol=2e-3, atol=2e-3)
    save_avatar(second, again)
    assert first.read_bytes() == second.read_bytes()


def test_gating_everything_is_refused(avatar):
    with pytest.raises(ValueError, match="at least one"):
        avatar.gate(torch.zeros(len(avatar.vertex_ids), dtype=torch.bool))


def test_bases_in_a_file_are_float16(tmp_path, body):
    avatar, path = an_avatar(body, "bases"), tmp_path / "avatar.safetensors"
    save_avatar(path, avatar)
    with safetensors.safe_open(path, "pt") as file:
        for name in ("offset", "log_scale", "color", "bases"):
            assert file.get_tensor(f"network.{name}").dtype == torch.float16
        assert file.get_tensor("network.signal_components").dtype == torch.float32
    avatar.representation.color.data[0, 0] = 1e6  # more than a float16 holds
    with pytest.raises(ValueError, match="color"):
        save_avatar(path, avatar)


def test_pose_far_outside_the_clip_changes_no_more_than_its_edge(body):
    avatar = an_avatar(body, "bases").eval()
    decoded = avatar.decode()
    limits = avatar.representation.signal_limits.abs().amax(0)
    most = (decoded.features.abs().view(len(avatar), 6, K) * limits).sum(-1)
    with torch.no_grad():
        for size in (1.0, 30.0):
            posed = avatar.pose(decoded, a_pose(seed=40, size=size))
            changed = (posed.color_logit - decoded.color_logit).abs()
            assert bool((changed <= most[:, :3] + 1e-4).all())
            unit = avatar.architecture.pose_offset_unit
            assert bool((posed.pose_offset.abs() <= unit * most[:, 3:] + 1e-6).all())


@pytest.mark.parametrize("name", ["theta", "expression"])
def test_driving_signal_that_is_not_finite_is_refused_by_name(body, name):
    avatar = an_avatar(body, "bases")
    told = {"theta": torch.zeros(54 * 6), "expression": torch.zeros(5)}
    told[name][2] = torch.nan
    for one in (avatar.representation, bake(avatar.eval()).representation):
        decoded = () if one is not avatar.representation else (avatar.decode(),)
        with pytest.raises(NotFiniteError, match=name):
            one.change(*decoded, Condition(**told), normals=lambda: torch.zeros(0, 3))


def test_no_bases_is_an_avatar_that_pose_and_face_do_not_change(tmp_path, body):
    avatar = an_avatar(body, "bases", bases=0).train()
    decoded = avatar.decode()
    posed = avatar.pose(decoded, a_pose())
    assert posed.pose_offset is None and torch.equal(posed.color_logit, decoded.color_logit)
    path = tmp_path / "avatar.safetensors"
    save_avatar(path, avatar)
    assert len(load_avatar(path, body).representation) == 0


def test_more_bases_than_the_clip_drives_are_refused(body):
    with pytest.raises(ValueError, match=f"drives {FRAMES - 1} bases, not 20"):
        an_avatar(body, "bases", bases=20)


def test_bases_of_what_no_frame_showed_are_zero(body):
    avatar = an_avatar(body, "bases")
    seen = torch.arange(len(avatar.base_color)) % 2 == 0
    avatar.representation.forget_unseen(seen)
    bases = avatar.representation.bases
    assert bool((bases[~seen] == 0).all()) and bool((bases[seen] != 0).any(1).all())
