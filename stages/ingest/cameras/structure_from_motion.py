"""Structure from motion on the background, with pycolmap.

SIFT features outside the widened person mask, matched to the frames around, mapped incrementally with one
pinhole for the whole clip. One thread and fixed seeds: equal frames give equal cameras.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.clip.frames import read_mask, spread_end_to_end, write_mask
from stages.ingest.cameras.background_motion import background_mask
from stages.ingest.cameras.calibration import Calibration
from stages.ingest.cameras.calibration_files import model_views

MOST_FRAMES = 200  # that are mapped, evenly spread; the others lie between them
FEATURES = 2048
OVERLAP = 8  # neighbours on either side that a frame is matched with, and the 2nd, 4th, 8th ... besides
REGISTERED = 0.6  # part of the mapped frames that must find a camera for the model to be believed
FOCAL_RANGE = (0.6, 1.8)  # of the initial focal length that the refined one may be
ATTEMPTS = ((16.0, 100, True), (4.0, 50, True), (4.0, 50, False))
"""Demands on the pair that COLMAP begins with, tried in turn: degrees at which rays cross, points, and if
the focal length is refined. COLMAP's own, the first, suit photographs from all around; people are filmed from
one side. (It halves both by itself where it finds no pair.)"""
LEAST_ANGLE = 1.0  # degrees; where the rays of points cross at less, a median over them, there is no baseline


def mapped_frames(frames: Sequence[int]) -> list[int]:
    """The frames that are mapped: all, or ``MOST_FRAMES`` of them with the first and the last."""
    return spread_end_to_end(frames, MOST_FRAMES)


def structure_from_motion(
    output: Path, work: Path, frames: Sequence[int], focal: float, centre: tuple[float, float]
) -> Calibration | str:
    """Cameras of the mapped frames, in an arbitrary unit and world.

    Args:
        output: the folder with ``frames`` and ``masks``.
        work: a folder for the database, emptied first and removed afterwards.
        frames: the kept frames, increasing.
        focal: initial focal length, pixels; refined, or kept where refining it runs off.
        centre: principal point, pixels.

    Returns:
        The cameras under their frames' file names; or the reason why there are none.
    """
    names = [f"{frame:06d}.png" for frame in mapped_frames(frames)]
    shutil.rmtree(work, ignore_errors=True)
    (work / "masks").mkdir(parents=True)
    try:
        _write_masks(output, work / "masks", mapped_frames(frames))
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
        pycolmap.set_random_seed(0)
        _match(output, work, names, focal, centre)
        for angle, points, refine in ATTEMPTS:
            found = _map(output, work, names, focal, _options(angle, points, refine))
            if not isinstance(found, str):
                return found
        return found
    except Exception as error:  # pycolmap raises what its C++ does: ValueError, RuntimeError, IndexError
        return f"COLMAP stopped: {str(error).splitlines()[-1] if str(error) else type(error).__name__}"
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _write_masks(output: Path, folder: Path, frames: Sequence[int]) -> None:
    """COLMAP looks for NAME.png beside the picture NAME and leaves out its black pixels."""
    for frame in frames:
        write_mask(folder, frame, background_mask(read_mask(output / "masks", frame)))
        (folder / f"{frame:06d}.png").rename(folder / f"{frame:06d}.png.png")


def _match(output: Path, work: Path, names: list[str], focal: float, centre: tuple[float, float]) -> None:
    """Features and verified matches into ``work/database.db``."""
    reader = pycolmap.ImageReaderOptions(
        mask_path=str(work / "masks"),
        camera_model="SIMPLE_PINHOLE",
        camera_params=f"{focal},{centre[0]},{centre[1]}",
    )
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    extraction.sift.max_num_features = FEATURES
    database = work / "database.db"
    pycolmap.extract_features(
        database, output / "frames", names, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.match_sequential(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False),
        pairing_options=pycolmap.SequentialPairingOptions(
            overlap=OVERLAP, quadratic_overlap=True, num_threads=1
        ),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _options(angle: float, points: int, refine: bool) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=0, multiple_models=False, extract_colors=False, min_model_size=3,
        ba_refine_focal_length=refine, ba_refine_principal_point=False,
    )  # fmt: skip
    mapper = options.mapper
    mapper.init_min_tri_angle, mapper.init_min_num_inliers = angle, points
    mapper.abs_pose_refine_focal_length = refine
    mapper.random_seed, mapper.num_threads = 0, 1
    options.triangulation.random_seed = 0
    return options


def _map(
    output: Path, work: Path, names: list[str], focal: float, options: pycolmap.IncrementalPipelineOptions
) -> Calibration | str:
    """The largest model, if it can be believed."""
    (work / "models").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(work / "database.db", output / "frames", work / "models", options)
    if not models:
        return "COLMAP found no two frames with a baseline"
    model = max(models.values(), key=lambda one: one.num_reg_images())
    registered = model.num_reg_images() / len(names)
    if registered < REGISTERED:
        return f"COLMAP placed {registered:.0%} of the frames only"
    calibration = model_views(model, work)
    ratio = next(iter(calibration.views.values())).lens.mean_focal_length() / focal
    if not FOCAL_RANGE[0] <= ratio <= FOCAL_RANGE[1]:
        return f"COLMAP's focal length ran off to {ratio:.2f} of the initial one"
    angle = crossing_angle(model)
    if angle < LEAST_ANGLE:
        return f"the rays of COLMAP's points cross at {angle:.2f} degrees only"
    return calibration


def crossing_angle(model: pycolmap.Reconstruction) -> float:
    """The widest angle between the rays that see a point, median over points, degrees; 0 without points."""
    centres = {number: model.image(number).projection_center() for number in model.reg_image_ids()}
    angles = []
    for point in model.points3D.values():
        rays = np.array([point.xyz - centres[one.image_id] for one in point.track.elements])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min())))
    return float(np.median(angles)) if angles else 0.0
