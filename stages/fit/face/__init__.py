"""Face first: a face fitted to the clip's face points before the body, as start and target of the body's.

``fit_face`` is the whole of it; :class:`FaceTarget` is what it hands on, whichever the source.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from pipeline.body import BodyModel, Landmarks
from pipeline.clip.frame_files import ClipFrames
from pipeline.clip.keypoints import FACE, Keypoints
from pipeline.numba_kernels import threads
from stages.fit.camera_batch import CameraBatch
from stages.fit.face.deca import FlameParameters, read_flame_parameters
from stages.fit.face.flame_model import FlameModel, load_flame
from stages.fit.face.from_mesh import face_from_mesh
from stages.fit.face.target import FaceModel, FaceTarget, face_model, sface
from stages.fit.observations import Observations
from stages.fit.settings import FitSettings

__all__ = ["FaceTarget", "fit_face", "sface"]

_MESH_POINTS, _FACE_POINTS = 478, 68
_NO_MESH = "; the keypoints hold no mesh of 478 points, which ingest.keypoints=mediapipe finds"
_SHAPES, _EXPRESSIONS = 100, 50  # DECA's, and the paper's, where DECA gives no start


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
        settings: those of the face that is fitted first are read; ``auto`` is ``mesh``.
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
    if settings.flame_fit and settings.face != "flame":
        log("face first: without FLAME, for no file of it is named: fit.face=flame fit.flame_model=FILE")
    with threads(1), torch.no_grad():
        flat = settings.face != "flame" and int(observations.of("face").sum()) == _FACE_POINTS
        model = face_model(body, landmarks.whole_body[FACE] if flat else landmarks.face_mesh)
        if settings.face == "flame":
            from stages.fit.face.from_flame import face_from_flame  # brings trimesh: a second

            flame = load_flame(Path(settings.flame_model))
            parameters = _deca(keypoints, settings, log, source)
            if settings.flame_fit:
                seen = _seen(body, landmarks, keypoints, observations)
                parameters = _fitted(seen, body, flame, parameters, views, settings, log)
            assert parameters is not None  # the settings ask for one of the two
            target = face_from_flame(model, body, flame, parameters)
        else:
            target = _from_keypoints(model, keypoints, observations, views)
    if target is None:
        log(f"face first: {_why_not(settings, observations)}")
        return None
    mean = model.mean[torch.searchsorted(model.rows, target.rows)]
    log(
        f"face first ({target.source}): fitted in {int(target.valid.sum())} of {len(target.valid)} frames, "
        f"{len(target.rows)} points, {1000 * float((target.neutral - mean).norm(dim=1).mean()):.1f} mm "
        f"from the mean face{_NO_MESH if flat else ''}"
    )
    return target


def _deca(
    keypoints: Keypoints, settings: FitSettings, log: Callable[[str], None], source: ClipFrames | None
) -> FlameParameters | None:
    """DECA's parameters; None where no folder is given."""
    if not settings.face_init:
        return None
    folder, first = Path(settings.face_init), settings.first_number
    return read_flame_parameters(folder, keypoints.frames, source, first, log)


def _seen(
    body: BodyModel, landmarks: Landmarks, keypoints: Keypoints, observations: Observations
) -> tuple[FaceModel, Tensor, Tensor]:
    """The face points that were detected: where they lie, pixels [T, F, 2] and mask [T, F]."""
    of = observations.of("face")
    deep = int(of.sum()) != _FACE_POINTS
    model = face_model(body, landmarks.face_mesh if deep else landmarks.whole_body[FACE])
    points = keypoints.face_mesh[..., :2] if deep else keypoints.whole_body[:, FACE, :2]
    return model, torch.from_numpy(points)[:, model.rows], observations.mask[:, of][:, model.rows]


def _fitted(
    seen: tuple[FaceModel, Tensor, Tensor],
    body: BodyModel,
    flame: FlameModel,
    start: FlameParameters | None,
    views: CameraBatch,
    settings: FitSettings,
    log: Callable[[str], None],
) -> FlameParameters:
    """FLAME's parameters after their fit to the points that were seen."""
    from stages.fit.face.flame_fit import fit_flame, flame_points, unknown_parameters  # brings trimesh

    model, pixels, mask = seen
    if start is None:
        most = (flame.shape_directions.shape[2], flame.expression_directions.shape[2])
        start = unknown_parameters(len(pixels), min(_SHAPES, most[0]), min(_EXPRESSIONS, most[1]))
    points = flame_points(model, body, flame)
    fit = fit_flame(points, start, pixels, mask, views, settings.lambda_flame_init)
    before, after = (float(error.nanmean()) for error in (fit.start_error, fit.error))
    count = int(torch.isfinite(fit.error).sum())
    points_off = f": {before:.2f} px off before, {after:.2f} after" if count else ""
    log(f"FLAME fitted to the 2D face points of {count} of {len(pixels)} frames{points_off}")
    return fit.parameters


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
        return "left out, for no face was found in any frame"
    return "left out, for no frame shows enough of a face"
