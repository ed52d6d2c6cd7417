"""A trained avatar to pose and to look at, for those who need know nothing of stages and folders.

``flexiavatar.load`` gives one. The world is in metres, Y up; a relaxed avatar faces +Z with its left at +X.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.avatar import Avatar, load_avatar
from pipeline.body import JOINT_NAMES, BodyModel, Pose, Poses, load_body, read_poses
from pipeline.body.expressions import Expressions, read_expressions
from pipeline.clip.camera import Camera
from pipeline.config.workspace import BUILT_IN
from pipeline.errors import UserError
from pipeline.orbit_cameras import relaxed_pose, view, visible_extent
from pipeline.splat import Gaussians, render

ARM_ANGLE = 1.0  # radians that the arms of the relaxed pose hang below the T pose
_AVATAR, _POSES = "avatar.safetensors", "poses.parquet"
_LARGEST_SIDE = 16_384  # pixels
_PARTS: Mapping[str, slice] = {
    "global_orient": slice(0, 1), "body_pose": slice(1, 22), "jaw_pose": slice(22, 23),
    "leye_pose": slice(23, 24), "reye_pose": slice(24, 25),
    "left_hand_pose": slice(25, 40), "right_hand_pose": slice(40, 55),
    **{name: slice(place, place + 1) for place, name in enumerate(JOINT_NAMES)},
}  # fmt: skip
"""SMPL-X's parameters, and single joints by name -> rows of ``Pose.rotation``."""


class PosableAvatar:
    """One person's avatar.

    A pose is the clip's in one of its ``frames``, or a relaxed one; on top of it ``pose`` sets parameters by
    SMPL-X's names (``global_orient``, ``body_pose``, ``jaw_pose``, ``left_hand_pose``, ``transl``,
    ``expression`` and so on) or single joints by theirs (``head``, ``left_elbow``): rotation vectors in
    radians, relative to the parent joint. ``expression`` sets the face by names, 1 for an expression's full
    range.

    Attributes:
        avatar: the trained avatar.
        body: the body that it was trained on.
        frames: the clip's frame numbers whose poses are known; none where no ``poses.parquet`` lies beside.
        expressions: the names of the face's expressions, ARKit's with the open body.
        joints: the names of the 55 joints.
    """

    def __init__(
        self, avatar: Avatar, body: BodyModel, expressions: Expressions, poses: Poses | None
    ) -> None:
        self.avatar, self.body = avatar, body
        self._expressions, self._poses = expressions, poses
        self.frames = () if poses is None else poses.frames
        self.expressions, self.joints = expressions.names, JOINT_NAMES

    def pose(
        self,
        frame: int | None = None,
        pose: Mapping[str, Any] | Pose | None = None,
        expression: Mapping[str, float] | None = None,
    ) -> Pose:
        """A pose, see the class.

        Args:
            frame: the clip's; the relaxed pose, with arms lowered, if None.
            pose: parameters to set on top of it, or a whole ``Pose`` in place of it.
            expression: expressions to set, in place of those that the pose has.

        Raises:
            UserError: there is no such frame, parameter or expression, or a value has another size or is not
                finite.
        """
        if isinstance(pose, Pose):
            found, given = pose, {}
        else:
            found, given = self._base(frame), dict(pose or {})
        rotation, transl, psi = found.rotation.clone(), found.transl.clone(), found.expression
        for name, value in given.items():
            if name == "transl":
                transl = _numbers(name, value, (3,))
            elif name == "expression":
                psi = self._coefficients(value)
            elif name in _PARTS:
                rows = _PARTS[name]
                rotation[rows] = _numbers(name, value, (rows.stop - rows.start, 3))
            else:
                known = ", ".join(["transl", "expression", *_PARTS])
                raise UserError(f"a pose has no {name!r}; it has {known}")
        if expression is not None:
            weights = {name: float(_numbers(name, weight, ())) for name, weight in expression.items()}
            psi = self._expressions.psi(weights)
        return Pose(rotation, psi, transl)

    @torch.no_grad()
    def gaussians(
        self,
        frame: int | None = None,
        pose: Mapping[str, Any] | Pose | None = None,
        expression: Mapping[str, float] | None = None,
    ) -> Gaussians:
        """The avatar's Gaussians in a pose, see ``pose``."""
        return self.avatar.gaussians(self.pose(frame, pose, expression))

    def render(
        self,
        frame: int | None = None,
        pose: Mapping[str, Any] | Pose | None = None,
        expression: Mapping[str, float] | None = None,
        *,
        size: int | tuple[int, int] = 512,
        yaw: float = 0.0,
        pitch: float = 0.0,
        intrinsics: Any = None,
        extrinsics: Any = None,
    ) -> np.ndarray:
        """A picture: [H, W, 4] float32 in [0, 1], RGB and alpha.

        Colours are encoded as the clip's are, sRGB as a rule, and not premultiplied.

        Args:
            frame, pose, expression: see ``pose``.
            size: pixels, of a square or (width, height).
            yaw: degrees that the camera stands round the person from +Z, where a clip's camera is; 90 sees
                the person's left. It stands as near as it can without cutting anything off.
            pitch: degrees that it stands above the level.
            intrinsics, extrinsics: a camera in place of that one: [3, 3], pixels, and world to camera, [4, 4]
                or [3, 4], metres, OpenCV's axes; one needs the other.

        Raises:
            UserError: as of ``pose``, or there is no such camera.
        """
        gaussians = self.gaussians(frame, pose, expression)
        camera = self._camera(gaussians, size, yaw, pitch, intrinsics, extrinsics)
        with torch.no_grad():
            rendering = render(gaussians, camera)
        alpha = rendering.alpha.clamp(0, 1)[..., None]
        color = torch.where(alpha > 0, rendering.color / alpha.clamp_min(1e-6), 0).clamp(0, 1)
        return torch.cat([color, alpha], 2).cpu().numpy().astype(np.float32)

    def save_splats(
        self,
        path: str | Path,
        frame: int | None = None,
        pose: Mapping[str, Any] | Pose | None = None,
        expression: Mapping[str, float] | None = None,
    ) -> None:
        """Writes the Gaussians in a pose as ``.ply`` (-Y up, as viewers expect), ``.spz`` or ``.glb``.

        Raises:
            UserError: as of ``pose``, or the suffix is another.
        """
        from pipeline.splat.splat_files import write_splats

        write_splats(Path(path), self.gaussians(frame, pose, expression), "-y", Path(path).stem)

    def save_rig(self, path: str | Path) -> None:
        """Writes the body as a rigged and textured mesh with expressions, a ``.glb`` (``pipeline.rig``)."""
        from pipeline.rig import avatar_colors, rigged_mesh, write_rig_glb
        from pipeline.rig.surface_colors import shown_vertices

        shown = shown_vertices(self.avatar, len(self.body.v_template))
        mesh = rigged_mesh(self.body, self.avatar.identity, self._expressions, shown)
        write_rig_glb(Path(path), mesh, avatar_colors(self.avatar, self.pose()), Path(path).stem)

    def _base(self, frame: int | None) -> Pose:
        """The pose that others are set on top of."""
        if frame is None:
            count = self._expressions.coefficients.shape[1]
            return Pose(relaxed_pose(ARM_ANGLE), torch.zeros(count), torch.zeros(3))
        if self._poses is None:
            raise UserError(f"frame {frame}: no {_POSES} lies beside the avatar; leave frame out")
        if frame not in self.frames:
            raise UserError(f"there is no frame {frame}; there are {_in_short(self.frames)}")
        return self._poses.pose(frame)

    def _coefficients(self, value: Any) -> Tensor:
        """The face from as many numbers as there are, up to the body's."""
        count, values = self._expressions.coefficients.shape[1], np.asarray(value, np.float32).reshape(-1)
        if len(values) > count:
            raise UserError(f"expression has {len(values)} coefficients, and the body {count}")
        return _numbers("expression", np.pad(values, (0, count - len(values))), (count,))

    def _camera(
        self, gaussians: Gaussians, size: Any, yaw: float, pitch: float, intrinsics: Any, extrinsics: Any
    ) -> Camera:
        sides = _sides(size)
        if (intrinsics is None) != (extrinsics is None):
            raise UserError("a camera needs both intrinsics and extrinsics")
        if intrinsics is None:
            angles = _numbers("yaw and pitch", (yaw, pitch), (2,)).tolist()
            turn, up = angles[0] / 360, math.radians(max(-90.0, min(90.0, angles[1])))
            return view(visible_extent(gaussians), *sides, turn, up)
        matrix = np.asarray(extrinsics, np.float32)
        matrix = matrix[:3] if matrix.shape == (4, 4) else matrix
        world = _numbers("extrinsics", matrix, (3, 4))
        return Camera(*sides, _numbers("intrinsics", intrinsics, (3, 3)), world[:, :3], world[:, 3])


def load_posable(path: Path, body_file: Path | None = None) -> PosableAvatar:
    """Loads an avatar, and the clip's poses where they lie beside it.

    Args:
        path: an ``avatar.safetensors``, the folder it lies in, or a subject's folder.
        body_file: the body model that it was trained on; the open one if None.

    Raises:
        UserError: there is no avatar, a file is damaged, or the body is another.
    """
    places = (path, path / _AVATAR, path / "train" / "latest" / _AVATAR)
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise UserError(f"{path}: no {_AVATAR} is there; make one: doit run subject=NAME source=CLIP.mp4")
    body_file = body_file or BUILT_IN / "body" / "open_body.npz"
    body = load_body(body_file)
    expressions = read_expressions(body_file, body.expression_directions.shape[2])
    poses = file.with_name(_POSES)
    return PosableAvatar(
        load_avatar(file, body), body, expressions, read_poses(poses) if poses.is_file() else None
    )


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
    """A value as float32 of a shape; UserError where it has another size or is not finite."""
    try:
        array = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        raise UserError(f"{name} holds no numbers") from None
    if array.size != math.prod(shape):
        raise UserError(f"{name} has shape {array.shape}, not {shape}")
    if not np.isfinite(array).all():
        raise UserError(f"{name} holds numbers that are not finite")
    return torch.from_numpy(array.reshape(shape).copy())


def _sides(size: Any) -> tuple[int, int]:
    """Width and height."""
    try:
        width, height = (operator.index(one) for one in (size if np.ndim(size) else (size, size)))
    except (TypeError, ValueError):
        width, height = 0, 0
    if not (1 <= width <= _LARGEST_SIDE and 1 <= height <= _LARGEST_SIDE):
        raise UserError(f"size={size}: one side or (width, height), 1 to {_LARGEST_SIDE} pixels each")
    return width, height


def _in_short(frames: tuple[int, ...]) -> str:
    return f"{len(frames)} from {frames[0]} to {frames[-1]}" if frames else "none"
