"""Where MediaPipe's models lie; no model is loaded."""

import pytest

from pipeline.detection.mediapipe import HEAVY_MODEL, place_heavy_model
from pipeline.errors import UserError


def folders(tmp_path):
    heavy, models = (
        tmp_path / "pose_heavy",
        tmp_path / "mediapipe" / "mediapipe" / "modules" / "pose_landmark",
    )
    heavy.mkdir()
    (heavy / HEAVY_MODEL).write_bytes(b"weights")
    models.mkdir(parents=True)
    return tmp_path / "mediapipe", heavy, models / HEAVY_MODEL


def test_the_heavy_model_is_put_beside_the_packages_own(tmp_path):
    asset, heavy, target = folders(tmp_path)
    place_heavy_model(asset, heavy)
    assert target.read_bytes() == b"weights" and len(list(target.parent.iterdir())) == 1
    target.write_bytes(b"half")
    place_heavy_model(asset, heavy)
    assert target.read_bytes() == b"weights"


def test_a_folder_that_cannot_take_it_is_named(tmp_path):
    asset, heavy, target = folders(tmp_path)
    target.parent.rmdir()
    target.parent.write_bytes(b"a file where a folder should be")
    with pytest.raises(UserError, match="pose_model=full"):
        place_heavy_model(asset, heavy)
