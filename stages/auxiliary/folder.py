"""Frames that somebody made elsewhere: our own layout, the peers' ``_gen`` folder, pictures, or a video.

- our layout: ``frames/``, ``poses.parquet`` and ``cameras.parquet``, and ``masks/`` if there are any, as
  the guidance folder has them, or of any other motion and cameras in the clip's world;
- the peers': ``frames/<id>.png``, ``smplx_optimized/smplx_params/<id>.json``, ``cam_params/<id>.json``,
  and where they are there ``masks/``, ``keypoints_whole_body/`` and ``frame_list_train.txt``, which says
  which frames are meant. Ids are the frames' numbers plus 100,000;
- a folder of pictures or a video: frame k shows frame k of the guidance, spread over all of it where
  there are fewer. A video is of the guidance's size; MimicMotion's output is.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from pipeline.body import Poses, read_poses, rest_joints
from pipeline.clip.camera import Camera, facing_camera
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.frame_files import number_files
from pipeline.clip.frames import spread_from_start
from pipeline.clip.keypoints import COUNT
from pipeline.clip.records import read_cameras
from pipeline.errors import UserError
from pipeline.pose_files import into_world, moved_pivot, read_hand_mean, read_smplx_json, tool_joints
from pipeline.untrusted import parse_json
from stages.auxiliary.generator_output import GeneratedPicture, GeneratorOutput
from stages.auxiliary.turntable_motion import ID_OFFSET, TurntableMotion

PICTURES = (".png", ".jpg", ".jpeg")
_REMEDY = "see docs/auxiliary.md for the layouts that auxiliary.folder may have"
_LARGEST = 1e6


def read_folder(path: Path, clip: FittedClip, turn: TurntableMotion, body_file: Path) -> GeneratorOutput:
    """The frames at ``path``, in any of the layouts.

    Raises:
        UserError: there is nothing there, or it cannot be read.
    """
    if path.is_file():
        return _video(path, turn)
    if not path.is_dir():
        raise UserError(f"{path} does not exist: {_REMEDY}")
    frames = path / "frames" if (path / "frames").is_dir() else path
    if (path / "smplx_optimized" / "smplx_params").is_dir():
        return _peers(path, frames, clip, body_file)
    if (path / "poses.parquet").is_file():
        return _ours(path, frames)
    files = list(numbered(frames).values())
    return GeneratorOutput(turn.poses, _cameras(turn), _spread(files, turn))


def numbered(folder: Path) -> dict[int, Path]:
    """The numbered pictures of a folder, frame number -> file, in order; UserError if there are none."""
    found = number_files(folder, PICTURES)
    if not found:
        raise UserError(f"{folder} holds no numbered pictures: {_REMEDY}")
    return found


def _ours(path: Path, frames: Path) -> GeneratorOutput:
    # Whatever their poses came from, the pictures were made from them.
    files, told = numbered(frames), read_poses(path / "poses.parquet")
    poses = Poses(told.frames, told.rotation, told.expression, told.transl)
    cameras = read_cameras(path / "cameras.parquet")
    masks = numbered(path / "masks") if (path / "masks").is_dir() else {}
    usable = [frame for frame in poses.frames if frame in files and frame in cameras]
    if not usable:
        raise UserError(f"{path}: no frame has a picture, a pose and a camera: {_REMEDY}")

    def pictures() -> Iterator[GeneratedPicture]:
        for frame in usable:
            mask = read_grey(masks[frame]) if frame in masks else None
            yield GeneratedPicture(frame, read_color(files[frame]), mask)

    return GeneratorOutput(poses, cameras, pictures())


def _peers(path: Path, frames: Path, clip: FittedClip, body_file: Path) -> GeneratorOutput:
    """The peers' ``_gen`` folder; frames are those with a picture, a pose and a camera, and on the list."""
    files = numbered(frames)
    files = {frame % ID_OFFSET: file for frame, file in files.items()}
    cameras = {
        number % ID_OFFSET: file for number, file in number_files(path / "cam_params", (".json",)).items()
    }
    listed = _listed(path / "frame_list_train.txt")
    parameters = path / "smplx_optimized" / "smplx_params"
    ids = {number % ID_OFFSET: number for number in number_files(parameters, (".json",))}
    usable = sorted({*files} & {*cameras} & {*ids} & (listed if listed is not None else {*files}))
    if not usable:
        raise UserError(f"{path}: no frame has a picture, a pose and a camera: {_REMEDY}")
    read = read_smplx_json(parameters, [ids[frame] for frame in usable], read_hand_mean(body_file))
    if read.transl is None:
        raise UserError(f"{parameters}: its files have no 'trans': {_REMEDY}")
    sizes = {frame: read_color(files[frame]).shape for frame in usable}
    views = {frame: _peer_camera(cameras[frame], sizes[frame]) for frame in usable}
    # Their world is OpenCV's camera, ours has Y up: cameras are carried over, and bodies with them.
    rotation = torch.stack([views[frame].rotation for frame in usable])
    translation = torch.stack([views[frame].translation for frame in usable])
    theirs, ours = tool_joints(clip.body, clip.identity)[0], rest_joints(clip.body, clip.identity)[0]
    orient, transl = into_world(read.rotation[:, 0], read.transl, theirs, rotation, translation)
    turned = read.rotation.clone()
    turned[:, 0] = orient.float()
    width = clip.poses.expression.shape[1]
    expression = torch.zeros(len(usable), width)
    if read.expression is not None:
        shared = min(width, read.expression.shape[1])
        expression[:, :shared] = read.expression[:, :shared]
    poses = Poses(tuple(usable), turned, expression, moved_pivot(orient, transl, theirs, ours).float())
    return GeneratorOutput(poses, views, _peer_pictures(path, files, usable))


def _peer_pictures(path: Path, files: dict[int, Path], usable: list[int]) -> Iterator[GeneratedPicture]:
    folders = (("masks", PICTURES), ("keypoints_whole_body", (".json",)))
    masks, points = (
        {number % ID_OFFSET: file for number, file in number_files(path / name, suffixes).items()}
        for name, suffixes in folders
    )
    for frame in usable:
        mask = read_grey(masks[frame]) if frame in masks else None
        keypoints = _whole_body(points[frame]) if frame in points else None
        yield GeneratedPicture(frame, read_color(files[frame]), mask, keypoints)


def _peer_camera(path: Path, size: tuple[int, ...]) -> Camera:
    value = parse_json(path, _REMEDY)
    try:
        rotation, translation = np.array(value["R"], float), np.array(value["t"], float).reshape(3)
        focal, centre = (np.array(value[name], float).reshape(2) for name in ("focal", "princpt"))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} lacks or misspells {error}: {_REMEDY}") from None
    proper = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not proper or focal.min() <= 0:
        raise UserError(f"{path}: R is no rotation, or a focal length is not positive: {_REMEDY}")
    upright = facing_camera(size[1], size[0], 1.0).rotation.double().numpy()
    intrinsics = torch.tensor([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]]).float()
    turned = torch.from_numpy(rotation @ upright).float()
    return Camera(size[1], size[0], intrinsics, turned, torch.from_numpy(translation).float())


def _video(path: Path, turn: TurntableMotion) -> GeneratorOutput:
    import av

    try:
        with av.open(str(path)) as container:
            images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except (av.FFmpegError, IndexError) as error:
        raise UserError(f"{path} cannot be read as a video ({error}): {_REMEDY}") from None
    if not images:
        raise UserError(f"{path} holds no frame: {_REMEDY}")
    return GeneratorOutput(turn.poses, _cameras(turn), _fitted(images, turn))


def _spread(files: list[Path], turn: TurntableMotion) -> Iterator[GeneratedPicture]:
    for place, frame in _places(len(files), turn):
        yield GeneratedPicture(frame, to_size(read_color(files[place]), turn.camera))


def _fitted(images: list[np.ndarray], turn: TurntableMotion) -> Iterator[GeneratedPicture]:
    for place, frame in _places(len(images), turn):
        yield GeneratedPicture(frame, to_size(images[place], turn.camera))


def _places(count: int, turn: TurntableMotion) -> list[tuple[int, int]]:
    """Pairs (picture, frame of the turn that it shows): all of the turn, or evenly spread."""
    return list(enumerate(spread_from_start(turn.poses.frames, count)))


def _cameras(turn: TurntableMotion) -> dict[int, Camera]:
    return dict.fromkeys(turn.poses.frames, turn.camera)


def to_size(image: np.ndarray, camera: Camera) -> np.ndarray:
    """A picture resampled to a camera's size."""
    if image.shape[:2] == (camera.height, camera.width):
        return image
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def read_color(path: Path) -> np.ndarray:
    """[H, W, 3] uint8 RGB; UserError if the file is no picture."""
    return np.ascontiguousarray(_decoded(path, cv2.IMREAD_COLOR)[..., ::-1])


def read_grey(path: Path) -> np.ndarray:
    """[H, W] uint8; UserError if the file is no picture."""
    return _decoded(path, cv2.IMREAD_GRAYSCALE)


def _decoded(path: Path, flags: int) -> np.ndarray:
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise UserError(f"{path} is not a readable picture: replace it or take it out")
    return image


def _listed(path: Path) -> set[int] | None:
    if not path.is_file():
        return None
    try:
        return {int(line) % ID_OFFSET for line in path.read_text(encoding="utf-8").split()}
    except ValueError as error:
        raise UserError(f"{path} must hold a frame number a line ({error})") from None


def _whole_body(path: Path) -> np.ndarray:
    value = parse_json(path, _REMEDY)
    try:
        points = np.array(value, np.float32)
    except (TypeError, ValueError):
        points = np.zeros(0, np.float32)
    if points.shape != (COUNT, 3) or not (np.abs(points) < _LARGEST).all():
        raise UserError(f"{path} does not hold {COUNT} points of x, y, score: {_REMEDY}")
    points[:, 2] = np.clip(points[:, 2], 0, 1)
    return points
