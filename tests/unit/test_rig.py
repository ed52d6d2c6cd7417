"""The body as a rigged mesh: avatar.glb."""

import dataclasses
import json

import numpy as np
import pytest
import roma
import torch
import trimesh

from pipeline.body import JOINT_NAMES, Pose, expression_offsets, load_body, mean_identity, posed_vertices
from pipeline.body.expressions import Expressions, read_expressions
from pipeline.errors import UserError
from pipeline.rig import SurfaceColors, rigged_mesh, write_rig_glb
from pipeline.rig.rigged_mesh import strongest_joints
from pipeline.rig.surface_colors import avatar_colors, bake_texture, shown_vertices
from tests.glb_reader import Glb
from tests.made.body import BODY_FILE, open_body
from tests.made.doll import awake_avatar
from tests.made.fake_body import official_arrays
from tests.node import run_script

ARKIT = {  # Apple's blend shapes of a face that are not the jaw's, the eyes' or the tongue's turns
    *(f"{name}{side}" for side in ("Left", "Right") for name in (
        "browDown", "browOuterUp", "cheekSquint", "eyeBlink", "eyeSquint", "eyeWide", "mouth", "mouthDimple",
        "mouthFrown", "mouthLowerDown", "mouthPress", "mouthSmile", "mouthStretch", "mouthUpperUp",
        "noseSneer",
    )),
    *("browInnerUp", "cheekPuff", "mouthFunnel", "mouthPucker", "mouthRollLower", "mouthRollUpper",
      "mouthShrugLower", "mouthShrugUpper"),
}  # fmt: skip


@pytest.fixture(scope="module")
def expressions():
    return read_expressions(BODY_FILE, open_body().expression_directions.shape[2])


@pytest.fixture(scope="module")
def identity():
    generator = torch.Generator().manual_seed(3)
    mean = mean_identity(open_body())
    return dataclasses.replace(
        mean,
        betas=torch.randn(len(mean.betas), generator=generator),
        joint_offset=0.005 * torch.randn(55, 3, generator=generator),
    )


@pytest.fixture(scope="module")
def mesh(expressions, identity):
    return rigged_mesh(open_body(), identity, expressions)


def striped():
    """A surface of which each place has a colour of its own."""
    body = open_body()
    normals = torch.nn.functional.normalize(body.v_template, dim=1)
    return SurfaceColors(
        body.v_template.numpy(), normals.numpy(), 0.5 + 0.4 * np.sin(9 * body.v_template.numpy())
    )


@pytest.fixture(scope="module")
def file(mesh, tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "avatar.glb"
    write_rig_glb(path, mesh, striped(), name="Ada, 2nd take", texture=64)
    return path


def poses():
    """Three poses of every joint, hands, jaw and eyes too."""
    generator = torch.Generator().manual_seed(5)
    return [0.5 * torch.randn(55, 3, generator=generator) for _ in range(3)]


def turns_of(rotation):
    return dict(zip(JOINT_NAMES, roma.rotvec_to_rotmat(rotation.double()).numpy(), strict=True))


@pytest.mark.parametrize("number", range(3))
def test_the_skinned_mesh_is_our_posed_body(number, file, mesh, identity, expressions):
    rotation, weights = poses()[number], {"mouthSmileLeft": 0.8, "browInnerUp": 1.0, "cheekPuff": 0.4}
    pose = Pose(rotation, expressions.psi(weights), torch.zeros(3))
    ours = posed_vertices(open_body(), identity, pose)[mesh.source]
    theirs = Glb(file).posed(turns_of(rotation), weights)
    assert np.abs(theirs - ours.numpy()).max() < 1e-4


def test_each_morph_target_is_its_expression(file, mesh, expressions):
    morphs = Glb(file).morphs()
    for name in expressions.names:
        moved = expression_offsets(open_body(), expressions.psi({name: 1.0})).numpy()[mesh.source]
        assert np.abs(morphs[name] - moved).max() < 1e-5
        assert np.abs(moved).max() > 1e-3


def test_the_expressions_have_arkits_names(file):
    assert set(Glb(file).morphs()) == ARKIT


@pytest.mark.parametrize("name", sorted(one for one in ARKIT if one.endswith("Left") and one != "mouthLeft"))
def test_a_side_is_the_persons_own(name, mesh):
    """The subject's left is +X, as ARKit means it."""
    left = next(morph for morph in mesh.morphs if morph.name == name)
    right = next(morph for morph in mesh.morphs if morph.name == name.replace("Left", "Right"))
    for morph, side in ((left, 1), (right, -1)):
        size = np.linalg.norm(morph.offsets, axis=1)
        assert side * (size * mesh.vertices[morph.rows, 0]).sum() / size.sum() > 0.005


def test_the_skeleton_has_smplx_names_and_places(file, mesh):
    asset = Glb(file).asset
    names = [asset.nodes[joint].name for joint in asset.skins[0].joints]
    assert names == list(JOINT_NAMES)
    for place, parent in enumerate(mesh.parents):
        above = [
            number
            for number, node in enumerate(asset.nodes)
            if asset.skins[0].joints[place] in (node.children or [])
        ]
        assert len(above) == 1
        if parent >= 0:
            assert asset.nodes[above[0]].name == JOINT_NAMES[parent]
    assert asset.nodes[asset.scenes[0].nodes[0]].name == "Ada, 2nd take"


def test_nothing_of_the_weights_is_cut_off(mesh):
    body = open_body()
    dense = np.zeros((len(mesh), 55))
    np.add.at(dense, (np.arange(len(mesh))[:, None], mesh.joint_ids), mesh.weights)
    assert mesh.cut == 0
    assert np.abs(dense - body.skinning_weights.numpy()[mesh.source]).max() < 1e-6


def test_the_first_set_has_the_largest_weights(mesh):
    assert (mesh.weights[:, :4].min(1) >= mesh.weights[:, 4:].max(1)).all()
    assert mesh.weights[:, :4].sum(1).min() > 0.9  # what a program that knows one set loses at most


def test_what_is_cut_off_is_said_and_the_rest_sums_to_one():
    weights = np.full((2, 55), 0.0)
    weights[0, :10], weights[1, 7] = 0.1, 1.0
    joints, shares, cut = strongest_joints(weights)
    assert cut == pytest.approx(0.2)
    assert np.allclose(shares.sum(1), 1) and joints.shape == (2, 8)
    assert joints[1].tolist() == [7, *[0] * 7]


def test_four_joints_are_one_set():
    weights = np.zeros((3, 55))
    weights[:, 3:7] = 0.25
    joints, _, cut = strongest_joints(weights)
    assert joints.shape == (3, 4) and cut == 0


def test_the_validator_finds_no_error(file):
    issues = run_script("validate.mjs", "gltf-validator", str(file))
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_trimesh_opens_it(file, mesh):
    scene = trimesh.load(file)
    (found,) = scene.geometry.values()
    assert len(found.faces) == len(mesh.faces)
    assert np.abs(found.bounds - np.stack([mesh.vertices.min(0), mesh.vertices.max(0)])).max() < 1e-5
    assert found.visual.uv.shape == (len(found.vertices), 2)
    assert found.visual.material.baseColorTexture.size == (64, 64)


def test_three_js_skins_and_morphs_it_as_we_do(file, mesh, identity, expressions):
    rotation, weights = poses()[0], {"mouthPucker": 1.0}
    unit = roma.rotvec_to_unitquat(rotation.double())  # (x, y, z, w), as three.js has them
    asked = {"bones": dict(zip(JOINT_NAMES, unit.tolist(), strict=True)), "morphs": weights}
    found = run_script("three_skin.mjs", "three", str(file), json.dumps(asked))
    pose = Pose(rotation, expressions.psi(weights), torch.zeros(3))
    ours = posed_vertices(open_body(), identity, pose)[mesh.source].numpy()
    away = np.linalg.norm(np.reshape(found["vertices"], (-1, 3)) - ours, axis=1)
    known = mesh.weights.shape[1] == 4 or (mesh.weights[:, 4:] == 0).all(1)
    assert known.mean() > 0.94
    assert away[known].max() < 1e-4
    assert away.max() < 0.02  # three.js reads the first set of weights alone
    assert found["bones"] == list(JOINT_NAMES) and set(found["morphs"]) == ARKIT and found["textured"]


def test_equal_meshes_give_equal_bytes(file, mesh, tmp_path):
    write_rig_glb(tmp_path / "again.glb", mesh, striped(), name="Ada, 2nd take", texture=64)
    assert (tmp_path / "again.glb").read_bytes() == file.read_bytes()


def test_the_texture_has_the_surfaces_colours(mesh):
    colors = striped()
    texture = bake_texture(mesh, colors, 256)
    rows = np.linspace(0, len(mesh) - 1, 400).astype(int)
    columns = np.clip((mesh.uv[rows] * 256).astype(int), 0, 255)
    found = texture[columns[:, 1], columns[:, 0]] / 255
    expected = colors.colors[mesh.source[rows]]
    assert np.median(np.abs(found - expected).max(1)) < 0.05
    assert np.quantile(np.abs(found - expected).max(1), 0.9) < 0.15


def test_only_what_the_avatar_shows_is_there(expressions):
    avatar, body = awake_avatar(gated=True), open_body()
    shown = shown_vertices(avatar, len(body.v_template))
    mesh = rigged_mesh(body, avatar.identity, expressions, shown)
    assert 0 < len(mesh) < 0.8 * len(body.v_template)
    assert bool(shown[mesh.source].all())
    avatar.unseen = "base"
    assert bool(shown_vertices(avatar, len(body.v_template)).all())


@pytest.mark.parametrize("unseen", ["nothing", "base"])
def test_an_avatars_colours_are_those_of_its_gaussians(unseen):
    avatar = awake_avatar(gated=True)
    avatar.unseen = unseen
    pose = Pose(torch.zeros(55, 3), torch.zeros(38), torch.zeros(3))
    colors, gaussians = avatar_colors(avatar, pose), avatar.gaussians(pose)
    assert np.allclose(colors.colors, gaussians.colors.detach())
    assert np.abs(colors.places - gaussians.means.detach().numpy()).max() < 0.2
    assert np.allclose(colors.at(colors.places[:50], colors.normals[:50]), colors.colors[:50], atol=0.05)


def test_colours_that_are_not_finite_are_left_out():
    colors = striped()
    spoilt = colors.colors.copy()
    spoilt[::2] = np.nan
    found = dataclasses.replace(colors, colors=spoilt).at(colors.places[:100], colors.normals[:100])
    assert np.isfinite(found).all() and np.abs(found - colors.colors[:100]).mean() < 0.1
    grey = dataclasses.replace(colors, colors=np.full_like(spoilt, np.nan)).at(
        colors.places[:3], colors.normals[:3]
    )
    assert (grey == 0.5).all()


def test_an_avatar_of_which_nothing_is_left_is_a_skeleton(expressions, identity, tmp_path):
    nothing = torch.zeros(len(open_body().v_template), dtype=torch.bool)
    mesh = rigged_mesh(open_body(), identity, expressions, nothing)
    write_rig_glb(tmp_path / "empty.glb", mesh, striped())
    asset = Glb(tmp_path / "empty.glb").asset
    assert not asset.meshes and {node.name for node in asset.nodes} > set(JOINT_NAMES)
    assert run_script("validate.mjs", "gltf-validator", str(tmp_path / "empty.glb"))["numErrors"] == 0


@pytest.fixture
def strange_body(tmp_path):
    """A body in the official layout without texture coordinates, expressions or names of these."""
    arrays = {name: values for name, values in official_arrays().items() if name not in ("vt", "ft")}
    arrays["shapedirs"][:, :, 300:] = 0
    np.savez(tmp_path / "body.npz", **arrays)
    return tmp_path / "body.npz"


def test_a_body_without_expressions_or_texture_has_colours_a_vertex(strange_body, tmp_path):
    body = load_body(strange_body)
    expressions = read_expressions(strange_body, body.expression_directions.shape[2])
    assert expressions.names == ("expression_00",)
    mesh = rigged_mesh(body, mean_identity(body), expressions)
    assert not mesh.morphs and mesh.cut > 0
    normals = np.tile([[0.0, 0.0, 1.0]], (len(body.v_template), 1))
    red = np.tile([[1.0, 0.0, 0.5]], (len(body.v_template), 1))
    write_rig_glb(tmp_path / "avatar.glb", mesh, SurfaceColors(body.v_template.numpy(), normals, red))
    glb = Glb(tmp_path / "avatar.glb")
    assert np.allclose(glb.attribute("COLOR_0"), [1, 0, 0.21404114, 1], atol=1e-4)  # in linear light
    issues = run_script("validate.mjs", "gltf-validator", str(tmp_path / "avatar.glb"))
    assert [
        one for one in issues["messages"] if one["severity"] == 0 and "DEGENERATE" not in one["code"]
    ] == []


def test_names_that_arkit_does_not_have_stay(tmp_path):
    np.savez(tmp_path / "body.npz", expression_units=np.array(["wink", "my own", "winkLeftMinusRight"]))
    found = read_expressions(tmp_path / "body.npz", 3)
    assert found.names == ("winkLeft", "winkRight", "my own")
    assert torch.allclose(found.psi({"winkLeft": 1, "winkRight": 1}), torch.tensor([3.0, 0, 0]))
    assert torch.allclose(found.psi({"winkLeft": 1, "winkRight": -1}), torch.tensor([0, 0, 3.0]))


@pytest.mark.parametrize(
    "names",
    [np.array(["a", "b"]), np.array(["a", "a", "b"]), np.arange(3), np.array("abc"), np.zeros((3, 2))],
)
def test_names_that_do_not_fit_are_numbered(names, tmp_path):
    np.savez(tmp_path / "body.npz", expression_units=names)
    assert read_expressions(tmp_path / "body.npz", 3).names == (
        "expression_00",
        "expression_01",
        "expression_02",
    )


def test_an_unknown_expression_is_refused_in_a_line(expressions):
    with pytest.raises(UserError, match="mouthSmileLeft"):
        expressions.psi({"mouthSmile": 1})


def test_expressions_of_no_file_are_refused(tmp_path):
    (tmp_path / "body.npz").write_bytes(b"no archive")
    with pytest.raises(UserError, match="body.npz"):
        read_expressions(tmp_path / "body.npz", 3)


def test_weights_of_expressions_add_up():
    pair = Expressions(("a", "b"), torch.eye(2))
    assert torch.equal(pair.psi({"a": 0.5, "b": 2}), torch.tensor([0.5, 2.0]))
