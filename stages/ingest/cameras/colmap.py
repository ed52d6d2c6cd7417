"""COLMAP models, text or binary, of any of its camera models."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from pipeline.errors import UserError
from stages.ingest.cameras.calibration import CalibratedCamera, Calibration

PLACES = (".", "sparse", "sparse/0", "0")
LOOKED_AT = 20  # pictures whose points say how far the scene is


def find_model(folder: Path) -> Path | None:
    """The folder in or under ``folder`` that holds a model; None where there is none."""
    for place in PLACES:
        if any((folder / place / f"cameras.{kind}").is_file() for kind in ("txt", "bin")):
            return folder / place
    return None


def read_model(folder: Path) -> Calibration:
    """The registered pictures of a model. Its unit is arbitrary, and so are the axes of its world.

    Raises:
        UserError: damaged, or without a registered picture.
    """
    try:
        model = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # pycolmap raises what its C++ does: ValueError, RuntimeError, IndexError
        reason = str(error).splitlines()[-1] if str(error) else type(error).__name__
        raise UserError(f"{folder} cannot be read as a COLMAP model ({reason}): export it again") from None
    return model_views(model, folder)


def model_views(model: pycolmap.Reconstruction, folder: Path) -> Calibration:
    """The registered pictures of a model that is in memory; UserError where there are none."""
    views = {}
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        pose = image.cam_from_world()
        lens = model.camera(image.camera_id)
        views[image.name] = CalibratedCamera(lens, pose.rotation.matrix(), np.array(pose.translation))
    if not views:
        raise UserError(f"{folder} is a COLMAP model without a registered picture: run COLMAP again")
    return Calibration(folder, "COLMAP", views, metric=False, upright=False, depth=scene_depth(model))


def scene_depth(model: pycolmap.Reconstruction) -> float:
    """The median depth of the points that some pictures see, in the model's unit; NaN without points."""
    numbers = sorted(model.reg_image_ids())
    depths = []
    for number in numbers[:: max(1, len(numbers) // LOOKED_AT)]:
        image = model.image(number)
        seen = [point.point3D_id for point in image.points2D if point.has_point3D()]
        if seen:
            points = np.array([model.point3D(one).xyz for one in seen])
            pose = image.cam_from_world()
            depths.append((points @ pose.rotation.matrix().T + pose.translation)[:, 2])
    return float(np.median(np.concatenate(depths))) if depths else float("nan")
