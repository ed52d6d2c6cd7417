"""Whose face it is: the numbers, and dlib on the sample clips where they are there."""

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.metrics.face_identity import FaceRecognizer, identity_cosine, identity_distance, medoid


def test_distance_and_cosine():
    first, second = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    assert identity_distance(first, second) == pytest.approx(2**0.5)
    assert identity_distance(first, first) == 0 and identity_cosine(first, 3 * first) == pytest.approx(1)
    assert identity_cosine(first, second) == 0
    with pytest.raises(ValueError, match="no direction"):
        identity_cosine(first, 0 * first)


def test_the_typical_face_is_a_real_one_and_no_outlier():
    faces = [np.array([0.0]), np.array([0.1]), np.array([0.2]), np.array([9.0])]
    assert medoid(faces)[0] in (0.1, 0.2)
    with pytest.raises(ValueError, match="no embeddings"):
        medoid([])


def test_missing_models_name_the_remedy(tmp_path, assets_folder):
    if not (assets_folder / "dlib").is_dir():
        pytest.skip("the asset dlib is not there")
    with pytest.raises(UserError, match="doit run assets:identity"):
        FaceRecognizer(assets_folder / "dlib", tmp_path)


@pytest.mark.assets
def test_one_man_is_himself_and_not_the_other(assets_folder):
    """Frames of smile and of carphone, which is small: 52 pixels of face."""
    import av

    for name in ("dlib", "identity", "smile", "carphone"):
        if not (assets_folder / name).is_dir():
            pytest.skip(f"the asset {name} is not there")
    reader = FaceRecognizer(assets_folder / "dlib", assets_folder / "identity")
    faces = {}
    for name, file in (("smile", "single_face.mp4"), ("carphone", "carphone_pristine.mp4")):
        with av.open(str(assets_folder / name / file)) as video:
            frames = [
                f.to_ndarray(format="rgb24") for f, _ in zip(video.decode(video=0), range(30), strict=False)
            ]
        faces[name] = [reader.read(frame) for frame in (frames[0], frames[-1])]
        box = faces[name][0].box
        assert 0 <= box.left < box.right <= frames[0].shape[1]
        assert 0 <= box.top < box.bottom <= frames[0].shape[0]
    smile, phone = ([face.embedding for face in faces[name]] for name in ("smile", "carphone"))
    assert identity_distance(*smile) < 0.45 and identity_distance(*phone) < 0.45
    assert min(identity_distance(a, b) for a in smile for b in phone) > 0.65
    assert reader.read(np.zeros((200, 200, 3), np.uint8)) is None
    assert reader.read(np.zeros((4, 4, 3), np.uint8)) is None
