"""TOML calibrations of rigs, in the forms that programs write, against OpenCV's projection."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import UserError
from stages.ingest.cameras.calibration_files import open_calibration
from stages.ingest.video import Clip

TABLES = {
    "a table a camera": "[cam_01]\n{body}\n[metadata]\nadjusted = false\n",
    "tables of one table": "[cameras.0]\n{body}\n[cameras.1]\nignore = true\nmatrix = []\n[metadata]\nn=2\n",
    "an array of tables": "[[cameras]]\n{body}\n",
    "with a byte-order mark": "\ufeff[cam_01]\n{body}\n",
}


CLIP = Clip(Path("clip.mp4"), 128, 96, 25.0, 4)


@pytest.mark.parametrize("form", TABLES)
@pytest.mark.parametrize("rotation", ["vector", "column", "matrix", "flat matrix"])
@pytest.mark.parametrize("bend", [[], [-0.2, 0.05, 0.001, -0.002], [-0.2, 0.05, 0.001, -0.002, 0.03]])
def test_a_toml_camera_in_any_form_agrees_with_opencv(
    tmp_path: Path, form: str, rotation: str, bend: list[float]
) -> None:
    turn, shift = np.array([1.2, -0.4, 0.3]), np.array([0.1, 0.2, 3.0])
    matrix = np.array([[150.0, 0, 60], [0, 151.0, 50], [0, 0, 1]])
    whole = cv2.Rodrigues(turn)[0]
    forms = {"vector": turn, "column": turn[:, None], "matrix": whole, "flat matrix": whole.ravel()}
    body = (
        f"size = [128, 96]\nmatrix = {matrix.tolist()}\ndistortions = {bend}\n"
        f"rotation = {forms[rotation].tolist()}\ntranslation = {shift[:, None].tolist()}"
    )
    (tmp_path / "Calib.toml").write_text(TABLES[form].format(body=body), encoding="utf-8")
    given = open_calibration(str(tmp_path / "Calib.toml"), "", CLIP)
    assert given is not None
    view = given.views[""]
    point = np.array([0.2, -0.3, 0.5])  # Z up
    expected = cv2.projectPoints(point[None], turn, shift, matrix, np.array(bend) if bend else None)[0][0, 0]
    there = view.rotation @ np.array([0.2, 0.5, 0.3]) + view.translation
    np.testing.assert_allclose(view.lens.img_from_cam(there), expected + 0.5, atol=1e-9)


def test_a_toml_camera_whose_matrix_is_no_rotation_is_refused(tmp_path: Path) -> None:
    (tmp_path / "Calib.toml").write_text(
        "[cam_01]\nsize = [128, 96]\nmatrix = [[150, 0, 60], [0, 150, 50], [0, 0, 1]]\n"
        "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\ntranslation = [0, 0, 3]\n"
    )
    with pytest.raises(UserError, match=r"Calib\.toml: the rotation is not one"):
        open_calibration(str(tmp_path / "Calib.toml"), "", CLIP)
