"""Face first: its target and terms, and the fit to the estimator's mesh against known truth."""

import dataclasses
import math

import numpy as np
import pytest
import roma
import torch

from pipeline.clip.keypoints import FACE, empty_keypoints
from pipeline.numba_kernels import threads
from stages.fit import terms
from stages.fit.face import fit_face
from stages.fit.face.from_mesh import densest_half, face_from_mesh
from stages.fit.face.target import FaceModel, aligned, face_model, make_target, sface
from stages.fit.observations import observe
from stages.fit.settings import FitSettings
from tests.made.faces import make_faces


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """As within ``fit_face``."""
    with threads(1):
        yield


@pytest.fixture(scope="module")
def face(model):
    return face_model(model[0], model[1].face_mesh)


@pytest.fixture(scope="module")
def clip(face):
    return make_faces(face, count=40, noise=0.7)


@pytest.fixture(scope="module")
def target(face, clip):
    return face_from_mesh(face, clip.mesh, torch.ones(clip.mesh.shape[:2], dtype=torch.bool), clip.views)


def rms(away):
    return float(away.square().sum(-1).mean().sqrt())


def displacement(face, expression):
    return (expression @ face.expression.flatten(0, 1).mT).unflatten(1, face.mean.shape)


def triangle(neutral):
    """A target of one triangle and a point of its own, for values worked out by hand."""
    points = torch.zeros(3, dtype=torch.long)
    model = FaceModel(
        points, None, neutral, torch.zeros(3, 3, 2), torch.zeros(3), torch.zeros(3), torch.tensor([[0, 1, 2]])
    )
    return make_target(model, neutral, torch.zeros(1, 2), torch.zeros(1, 3), torch.ones(1).bool(), "mesh")


# The terms of Eq. 4


def test_face_vertex_loss():
    points = torch.tensor([[1.0, -2.0, 0.5], [0.0, 0.0, 0.0]])
    assert terms.face_vertex_loss(points, torch.zeros(2, 3)).tolist() == [3.5, 0.0]


def test_face_laplacian_loss():
    points = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    laplacian = triangle(torch.eye(3)).laplacian
    assert laplacian.tolist() == [[-1.0, 0.5, 0.5], [0.5, -1.0, 0.5], [0.5, 0.5, -1.0]]
    loss = terms.face_laplacian_loss(points, torch.zeros(3, 3), laplacian)
    assert loss.tolist() == [9.0, 2.25, 2.25]
    shifted = terms.face_laplacian_loss(points + 1, points, laplacian)
    assert shifted.tolist() == pytest.approx([0.0, 0.0, 0.0])


def test_face_edge_loss():
    points = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 1.0, 0.0]])
    target = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    loss = terms.face_edge_loss(points, target, torch.tensor([[0, 1], [0, 2], [1, 1]]))
    assert loss.tolist() == [3.0, 3.0, 0.0]


def test_gradients_of_the_terms():
    draw = torch.Generator().manual_seed(0)
    points, target = (torch.randn(6, 3, generator=draw, dtype=torch.float64) for _ in range(2))
    points.requires_grad_()
    laplacian = torch.randn(6, 6, generator=draw, dtype=torch.float64)
    edges = torch.tensor([[0, 1], [2, 5], [3, 4]])
    check = torch.autograd.gradcheck
    assert check(lambda p: terms.face_vertex_loss(p, target), points)
    assert check(lambda p: terms.face_laplacian_loss(p, target, laplacian), points)
    assert check(lambda p: terms.face_edge_loss(p, target, edges), points)


def test_sface_asks_for_shape_and_not_for_place_or_size():
    neutral = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])
    turn = roma.rotvec_to_rotmat(torch.tensor([0.4, -0.2, 1.0]))
    same = 1.3 * neutral @ turn.mT + torch.tensor([0.0, 1.0, 2.0])
    losses = sface(same, triangle(neutral))
    assert set(losses) == {"vertex", "laplacian", "edge"}
    assert all(loss.abs().max() < 1e-6 for loss in losses.values())
    other = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.2, 0.0]], requires_grad=True)
    losses = sface(other, triangle(neutral))
    assert losses["vertex"].shape == (3,) and losses["edge"].shape == (3,)
    sum(loss.sum() for loss in losses.values()).backward()
    assert torch.isfinite(other.grad).all() and other.grad.abs().sum() > 0
    # Growing about the middle, and moving, change nothing: no gradient that way.
    away = (other - other.mean(0)).detach()
    assert abs(float((other.grad * away).sum())) < 1e-5 * float(other.grad.norm() * away.norm())
    assert other.grad.sum(0).abs().max() < 1e-5 * other.grad.abs().max()


# The face of the body


def test_face_points_lie_on_skin_and_are_meshed_along_it(face):
    assert 460 <= len(face.rows) <= 468 and face.rows.max() < 468  # no iris
    corners = face.mean[face.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = corners.mean(1) - (face.mean.mean(0) + torch.tensor([0.0, 0.0, -0.06]))
    assert ((normals * outwards).sum(1) > 0).float().mean() > 0.97
    jaws = face.jaw_weight[face.faces]
    assert (jaws.amax(1) - jaws.amin(1)).max() < 0.5
    assert len(torch.unique(face.faces)) > 0.98 * len(face.rows)


def test_part_of_a_face_keeps_its_triangles(face):
    chosen = face.mean[:, 0] > 0
    part = face.part(chosen)
    assert len(part.rows) == int(chosen.sum()) and len(part.points) == len(part.rows)
    assert 0 < len(part.faces) < len(face.faces) and part.faces.max() < len(part.rows)
    assert torch.equal(part.mean, face.mean[chosen])


# The estimator's mesh


def test_neutral_face_is_nearer_than_the_mean_face(face, clip, target):
    mean = rms(aligned(face.mean, clip.neutral) - clip.neutral)
    fitted = rms(aligned(target.neutral, clip.neutral) - clip.neutral)
    assert mean > 0.002
    assert fitted < 0.4 * mean


def test_expression_is_nearer_than_none(face, clip, target):
    zero = rms(displacement(face, clip.expression))
    fitted = rms(displacement(face, target.expression - clip.expression))
    assert fitted < 0.5 * zero
    for unit in (0, 2):
        assert np.corrcoef(target.expression[:, unit], clip.expression[:, unit])[0, 1] > 0.95


def test_jaw_and_head_are_found(clip, target):
    assert target.valid.all()
    assert (target.jaw[:, 0] - clip.jaw).abs().max() < 0.06
    assert (target.jaw[:, 1:] == 0).all()
    turn = roma.rotmat_geodesic_distance(target.orientation, clip.orientation)
    assert turn.max() < math.radians(6)


def test_few_noisy_frames_do_not_spoil_the_mean_face(face):
    clip = make_faces(face, count=5, noise=2.0)  # which is 4 mm, twice the face's own shape
    mask = torch.ones(clip.mesh.shape[:2], dtype=torch.bool)
    found = face_from_mesh(face, clip.mesh, mask, clip.views)
    own = rms(aligned(found.neutral, clip.neutral) - clip.neutral)
    mean = rms(aligned(face.mean, clip.neutral) - clip.neutral)
    assert own < mean
    assert rms(found.neutral - face.mean) < 0.004


def test_outliers_and_missing_frames(face, clip, target):
    mesh, mask = clip.mesh.clone(), torch.ones(clip.mesh.shape[:2], dtype=torch.bool)
    mask[3] = False
    mesh[3] = torch.nan
    mesh[7] = mesh[7, torch.randperm(mesh.shape[1], generator=torch.Generator().manual_seed(0))]
    mesh[:, :10, :2] += 30.0  # ten points are always wrong
    mask[9, ::3] = False
    found = face_from_mesh(face, torch.nan_to_num(mesh), mask, clip.views)
    assert found.valid.tolist() == [row not in (3, 7) for row in range(40)]
    for values in (found.expression, found.jaw, found.neutral, found.orientation):
        assert torch.isfinite(values).all()
    assert (found.expression[[3, 7]] == 0).all() and (found.jaw[[3, 7]] == 0).all()
    assert rms(aligned(found.neutral, clip.neutral) - clip.neutral) < 0.002
    assert rms(displacement(face, found.expression - target.expression)[9]) < 0.0008


def test_nothing_seen_is_no_face(face, clip):
    assert face_from_mesh(face, clip.mesh, torch.zeros(clip.mesh.shape[:2]).bool(), clip.views) is None


def test_camera_of_its_own_turns_the_head_with_the_world(face, clip, target):
    turn = roma.rotvec_to_rotmat(torch.tensor([0.0, 1.2, 0.0]))
    moved = dataclasses.replace(clip.views, rotation=clip.views.rotation @ turn)
    found = face_from_mesh(face, clip.mesh, torch.ones(clip.mesh.shape[:2]).bool(), moved)
    assert torch.equal(found.neutral, target.neutral)
    assert torch.allclose(found.orientation, turn.mT @ target.orientation, atol=1e-5)


def test_densest_half():
    rests = torch.tensor([[0.0], [5.0], [0.2], [-9.0], [0.1]])
    assert densest_half(rests).tolist() == pytest.approx([0.1])
    assert densest_half(torch.cat([rests, -rests], dim=1)).tolist() == pytest.approx([0.1, -0.1])
    assert densest_half(torch.tensor([[3.0]])).tolist() == [3.0]


# The interface


def keypoints_of(clip, rows):
    count = len(clip.mesh)
    keypoints = empty_keypoints(np.arange(count))
    keypoints.face_mesh[:, rows, :3] = clip.mesh
    keypoints.face_mesh[:, rows, 3] = 1
    keypoints.pose_image[..., 3] = 0.1  # that there is a pose at all says that this is MediaPipe
    return keypoints


def fitted(model, keypoints, views, settings):
    said = []
    observed = observe(keypoints, model[1], 0.4, views.size.numpy(), settings.masked)
    return fit_face(*model, keypoints, observed, views, settings, said.append), said


def test_fit_face_gives_the_same_twice_on_any_number_of_threads(model, face, clip, target):
    keypoints = keypoints_of(clip, face.rows.numpy())
    before, results = torch.get_num_threads(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        try:
            results.append(fitted(model, keypoints, clip.views, FitSettings())[0])
        finally:
            torch.set_num_threads(before)
    for name in ("neutral", "expression", "jaw", "orientation", "valid", "rows", "edges"):
        assert torch.equal(getattr(results[0], name), getattr(results[1], name)), name
    assert rms(results[0].neutral - target.neutral) < 0.0005


def test_fit_face_says_what_it_did(model, face, clip):
    keypoints = keypoints_of(clip, face.rows.numpy())
    found, said = fitted(model, keypoints, clip.views, FitSettings(face="mesh"))
    assert found.source == "mesh" and len(said) == 1 and "(mesh): fitted in" in said[0]
    _, said = fitted(model, keypoints, clip.views, FitSettings(flame_fit=True))  # as in the paper preset
    assert "fit.flame_model" in said[0] and "(mesh): fitted in" in said[1]
    found, said = fitted(model, keypoints, clip.views, FitSettings(face="off"))
    assert found is None and said == ["face first: switched off"]
    keypoints.face_mesh[..., 3] = 0.1
    found, said = fitted(model, keypoints, clip.views, FitSettings())
    assert found is None and "no frame shows" in said[0]
    found, said = fitted(model, empty_keypoints(np.arange(40)), clip.views, FitSettings())
    assert found is None and "no frame shows" in said[0]


def test_the_68_points_of_the_133_serve_where_there_is_no_mesh(model):
    face = face_model(model[0], model[1].whole_body[FACE])
    assert len(face.rows) == 68
    clip = make_faces(face, count=40, noise=0.5)
    keypoints = empty_keypoints(np.arange(40))
    keypoints.whole_body[:, FACE, :2] = clip.mesh[..., :2]
    keypoints.whole_body[:, FACE, 2] = 1
    keypoints.whole_body[20, FACE, 2] = 0.1
    found, said = fitted(model, keypoints, clip.views, FitSettings())
    assert found.source == "points" and "(points): fitted in 39 of 40" in said[0]
    assert "ingest.keypoints=mediapipe" in said[0] and len(said) == 1
    assert not found.valid[20]
    turned = roma.rotmat_geodesic_distance(found.orientation, clip.orientation)[found.valid]
    assert turned.median() < 0.06 and turned.max() < 0.2
    assert rms(found.neutral - face.mean) < 0.004
    moved, truth = displacement(face, found.expression), displacement(face, clip.expression)
    assert rms((moved - truth)[found.valid]) < 0.7 * rms(truth[found.valid])
    terms_of = sface(face.mean, found)
    assert all(float(value.mean()) > 0 for value in terms_of.values())
