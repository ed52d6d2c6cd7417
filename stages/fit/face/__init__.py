"""Face first: a face fitted to the clip's face points before the body, as start and target of the body's.

``fit_face`` is the whole of it; :class:`FaceTarget` is what it hands on, whichever the source.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from pipeline.body import BodyModel, Landmarks
from pipeline.clip.frame_files import ClipFrames
from pipeline.clip.keypoints import FACE, Keypoints
from pipeline.numba_kernels import threads
from stages.fit.camera_batch import CameraBatch
from stages.fit.face.deca import read_flame_parameters
from stages.fit.face.flame_model import load_flame
from stages.fit.face.from_mesh import face_from_mesh
from stages.fit.face.target import FaceModel, FaceTarget, face_model, sface
from stages.fit.observations import Observations
from stages.fit.settings import FitSettings

__all__ = ["FaceTarget", "fit_face", "sface"]

_MESH_POINTS, _FACE_POINTS = 478, 68


def fit_face(
    body: BodyModel,
    landmarks: Landmarks,
    keypoints: Keypoints,
    observations: Observations,
    views: CameraBatch,
    settings: FitSettings,
    log: Callable[[str], None] = lambda line: None,
    source: ClipFrames | None = None,
) -> FaceTarget | None:
    """Fit a face to the clip by the source that ``settings.face`` names.

    Args:
        landmarks: where the face mesh lies on it.
        keypoints: the clip's detections; their face mesh is read, or without one the 68 face points.
        observations: made of the same keypoints; says which face points to trust.
        settings: ``face``, ``face_init`` and ``flame_model`` are read; ``auto`` is ``mesh``.
        log: told in a line each what was fitted, or why nothing was, and how files were matched.
        source: all frames of the footage, which names of files mean; None: their numbers are frame numbers.

    Returns:
        None if it is switched off or no face was seen.

    Raises:
        UserError: FLAME's model or parameters cannot be used.
    """
    if settings.face == "off":
        log("face first: switched off")
        return None
    with threads(1), torch.no_grad():
        flat = settings.face != "flame" and int(observations.of("face").sum()) == _FACE_POINTS
        model = face_model(body, landmarks.whole_body[FACE] if flat else landmarks.face_mesh)
        if settings.face == "flame":
            folder, first = Path(settings.face_init), settings.first_number
            parameters = read_flame_parameters(folder, keypoints.frames, source, first, log)
            from stages.fit.face.from_flame import face_from_flame  # brings trimesh: a second

            target = face_from_flame(model, body, load_flame(Path(settings.flame_model)), parameters)
        else:
            target = _from_keypoints(model, keypoints, observations, views)
    if target is None:
        log(f"face first: {_why_not(settings, observations)}")
        return None
    mean = model.mean[torch.searchsorted(model.rows, target.rows)]
    log(
        f"face first ({target.source}): fitted in {int(target.valid.sum())} of {len(target.valid)} frames, "
        f"{len(target.rows)} points, {1000 * float((target.neutral - mean).norm(dim=1).mean()):.1f} mm "
        "from the mean face"
    )
    return target


def _from_keypoints(
    model: FaceModel, keypoints: Keypoints, observations: Observations, views: CameraBatch
) -> FaceTarget | None:
    mask = observations.mask[:, observations.of("face")]
    if not mask.any():
        return None
    deep = mask.shape[1] == _MESH_POINTS
    points = keypoints.face_mesh[..., :3] if deep else keypoints.whole_body[:, FACE, :2]
    return face_from_mesh(model, torch.from_numpy(points)[:, model.rows], mask[:, model.rows], views)


def _why_not(settings: FitSettings, observations: Observations) -> str:
    if settings.face == "flame":
        return "left out, for DECA found no face in any frame"
    return "left out, for no frame shows enough of a face"
