"""ArcFace: alignment by five points, the network's input, and files that are another model."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.metrics.arcface import TEMPLATE, ArcFace, aligned, five_points, similarity
from pipeline.metrics.face_identity import identity_cosine
from stages.evaluate.frame_metrics import open_arcface
from tests.made.onnx_models import pooled_model

WEIGHTS = np.random.default_rng(0).standard_normal((48, 512)).astype(np.float32)


def write(tmp_path, content: bytes):
    path = tmp_path / "model.onnx"
    path.write_bytes(content)
    return path


def picture(seed: int = 0, side: int = 112) -> np.ndarray:
    small = np.random.default_rng(seed).integers(0, 256, (8, 8, 3), np.uint8)
    return cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC)


def expected(face: np.ndarray) -> np.ndarray:
    """The model's own definition in numpy: tiles of RGB in [-1, 1], channel by channel."""
    scaled = (face.astype(np.float64) - 127.5) / 127.5
    tiles = scaled.reshape(4, 28, 4, 28, 3).mean((1, 3))
    return tiles.transpose(2, 0, 1).ravel() @ WEIGHTS.astype(np.float64)


@pytest.mark.parametrize("normalises", [False, True])
@pytest.mark.parametrize("batch", [1, "None"])
def test_the_embedding_is_the_models(tmp_path, normalises, batch):
    model = pooled_model(WEIGHTS, (batch, 3, 112, 112), normalises=normalises)
    found = ArcFace(write(tmp_path, model)).embed(picture(), TEMPLATE)
    assert found.shape == (512,)
    np.testing.assert_allclose(found, expected(picture()), atol=2e-3)  # a face in its place is not touched


def test_without_a_file_the_papers_protocols_say_what_is_missing(tmp_path):
    said: list[str] = []
    assert open_arcface("", "ours", said.append) is None and not said
    assert open_arcface("", "paper_black", said.append) is None and "evaluate.arcface" in said.pop()
    file = write(tmp_path, pooled_model(WEIGHTS))
    assert isinstance(open_arcface(str(file), "paper", said.append), ArcFace) and not said
    with pytest.raises(UserError, match="evaluate.arcface"):
        open_arcface(str(tmp_path / "none.onnx"), "paper", said.append)


def test_a_face_is_known_wherever_it_is(tmp_path):
    arcface = ArcFace(write(tmp_path, pooled_model(WEIGHTS)))
    face, other = picture(0), picture(1)
    turn = np.deg2rad(25)
    move = 3.4 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    matrix = np.column_stack([move, [400.0, 90.0]])
    shown = cv2.warpAffine(face, matrix, (900, 800))
    points = TEMPLATE @ move.T + matrix[:, 2]
    near, far = arcface.embed(shown, points), arcface.embed(other, TEMPLATE)
    assert identity_cosine(near, arcface.embed(face, TEMPLATE)) > 0.98
    assert identity_cosine(near, far) < 0.6
    assert aligned(shown, points).shape == (112, 112, 3)


def test_the_similarity_is_the_least_squares():
    random = np.random.default_rng(3)
    points, target = random.normal(size=(5, 2)), random.normal(size=(5, 2))
    rows = [[x, -y, 1, 0] for x, y in points] + [[y, x, 0, 1] for x, y in points]
    a, b, x, y = np.linalg.lstsq(np.array(rows), target.T.ravel(), rcond=None)[0]
    np.testing.assert_allclose(similarity(points, target), [[a, -b, x], [b, a, y]], atol=1e-12)
    with pytest.raises(ValueError, match="one place"):
        similarity(np.ones((5, 2)), target)


def test_five_points_of_whole_body_points():
    points = np.zeros((133, 3))
    points[:, 2] = 0.9
    face = points[23:91]
    for place, (x, y) in zip((range(36, 42), range(42, 48), [30], [48], [54]), TEMPLATE, strict=True):
        face[list(place), :2] = (x, y)
    np.testing.assert_allclose(five_points(points), TEMPLATE)
    for spoilt in ((23 + 30, 2, 0.1), (23 + 40, 0, np.nan)):
        worse = points.copy()
        worse[spoilt[:2]] = spoilt[2]
        assert five_points(worse) is None


@pytest.mark.parametrize(
    "content",
    [
        pooled_model(WEIGHTS[:, :128]),
        pooled_model(WEIGHTS[:, :128], given=(1, 512)),  # the file says what is not so
        pooled_model(WEIGHTS, (1, 3, 224, 224), side=224),
        pooled_model(WEIGHTS, (1, 112, 112, 3)),
        pooled_model(WEIGHTS, (1, 1, 112, 112)),
        pooled_model(WEIGHTS, (3, 112, 112)),
        pooled_model(WEIGHTS)[:-20],
        pooled_model(WEIGHTS)[:200],
        b"",
        b"no model at all",
        b"\xff" * 64,
        b"\x3a\xff\xff\xff\xff\x0f",
    ],
    ids=range(12),
)
def test_another_model_is_refused_in_one_line(tmp_path, content):
    with pytest.raises(UserError, match=r"model\.onnx") as caught:
        ArcFace(write(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_no_file_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"gone\.onnx"):
        ArcFace(tmp_path / "gone.onnx")
