"""An avatar and motions as one compressed block of bytes, as ``page/posing.js`` reads it.

Gzip around: the length of the header as uint32, the header as JSON, and the arrays one after the other. Each
array is stored as float32, or as whole numbers of one or two bytes that stand for ``low + step * number``,
``low`` and ``step`` one for all or one for each column. Numbers of two bytes are stored as all low bytes,
then all high bytes, and bases and expressions direction by direction: gzip packs that best. Equal avatars
give equal bytes.
"""

from __future__ import annotations

import dataclasses
import gzip
import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import roma
import torch

from pipeline.avatar.linear_avatar import LinearAvatar
from pipeline.body import JOINT_NAMES, PARTS
from pipeline.clip.camera import Camera

FORMAT = 1
MOVE_STEP = 2e-5  # metres: with 16 bases of unit variance, rounding moves a point by 0.02 mm
COLOR_STEP = 0.01  # logits, of which one of 255 levels is at least 0.016
EXPRESSION_STEP = 5e-6  # metres a unit of expression, of which many add up to twenty and more
MIDDLE = 0x8080  # stands for zero: small numbers of both signs then share their high byte
COMPRESSION = 6


@dataclasses.dataclass(frozen=True)
class ViewedMotion:
    """A motion that the page can play, T frames.

    Attributes:
        name: for people.
        fps: frames a second.
        rotation: [T, 55, 3], rotation vectors, radians.
        expression: [T, E]; E = 0 for none.
        transl: [T, 3], metres.
        cameras: of every frame, where it was filmed; else empty.
        numbers: of the filmed frames that the server can show beside it; else empty.
    """

    name: str
    fps: float
    rotation: np.ndarray
    expression: np.ndarray
    transl: np.ndarray
    cameras: Sequence[Camera] = ()
    numbers: Sequence[int] = ()

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.rotation)


class _Arrays:
    """Arrays as they are added: their descriptions, and their bytes."""

    def __init__(self) -> None:
        self.described: dict[str, dict[str, Any]] = {}
        self.chunks: list[bytes] = []
        self._at = 0

    def _add(self, name: str, kind: str, shape: Sequence[int], content: bytes, **more: Any) -> None:
        self.described[name] = {"kind": kind, "shape": list(shape), "at": self._at, **more}
        padded = content + bytes(-len(content) % 4)
        self.chunks.append(padded)
        self._at += len(padded)

    def floats(self, name: str, values: np.ndarray) -> None:
        """Exactly."""
        self._add(name, "f32", values.shape, np.ascontiguousarray(values, "<f4").tobytes())

    def bytes_(self, name: str, values: np.ndarray) -> None:
        """Whole numbers from 0 to 255."""
        self._add(name, "u8", values.shape, np.ascontiguousarray(values, np.uint8).tobytes())

    def ranged(self, name: str, values: np.ndarray, bits: int) -> None:
        """Each column's range, [N, C], in equal steps."""
        wide = values.astype(np.float64)
        low = wide.min(0) if len(wide) else np.zeros(wide.shape[1])
        high = wide.max(0) if len(wide) else low
        step = np.maximum((high - low) / (2**bits - 1), 1e-12)
        self._whole(name, np.rint((wide - low) / step), bits, low.tolist(), step.tolist())

    def stepped(self, name: str, values: np.ndarray, step: float) -> None:
        """In steps of a known size around zero, two bytes each; what lies beyond is clamped."""
        numbers = np.clip(np.rint(values.astype(np.float64) / step) + MIDDLE, 0, 0xFFFF)
        self._whole(name, numbers, 16, [-MIDDLE * step], [step])

    def _whole(self, name: str, numbers: np.ndarray, bits: int, low: list[float], step: list[float]) -> None:
        if bits == 8:
            content = numbers.astype(np.uint8).tobytes()
        else:
            halves = numbers.astype(np.uint16)
            content = (halves & 255).astype(np.uint8).tobytes() + (halves >> 8).astype(np.uint8).tobytes()
        self._add(name, f"u{bits}", numbers.shape, content, low=low, step=step)


def pack(
    avatar: LinearAvatar,
    motions: Sequence[ViewedMotion] = (),
    expressions: Mapping[str, Sequence[float]] | None = None,
    still_pose: np.ndarray | None = None,
) -> bytes:
    """An avatar and motions as the page reads them.

    Args:
        avatar: what is shown.
        motions: what it can be seen in.
        expressions: what has a slider: name -> coefficients of its full range.
        still_pose: [55, 3] rotation vectors in which it stands still; the T pose if None.
    """
    arrays = _Arrays()
    _add_avatar(arrays, avatar)
    for place, motion in enumerate(motions):
        _add_motion(arrays, f"motion{place}", motion)
    still = np.zeros((len(JOINT_NAMES), 3)) if still_pose is None else still_pose
    header = {
        "format": FORMAT,
        "count": len(avatar),
        "bases": len(avatar.signal),
        "expression_count": avatar.expressions.shape[2],
        "expressions": [
            {"name": name, "coefficients": [float(one) for one in coefficients]}
            for name, coefficients in (expressions or {}).items()
        ],
        "still_pose": [float(one) for one in np.asarray(still).ravel()],
        "joint_names": list(JOINT_NAMES),
        "part_names": list(PARTS),
        "parents": list(avatar.parents),
        "motions": [
            {"name": one.name, "fps": one.fps, "frames": len(one), "numbers": list(one.numbers),
             "filmed": bool(one.cameras), "size": [one.cameras[0].width, one.cameras[0].height]
             if one.cameras else []}
            for one in motions
        ],
        "arrays": arrays.described,
    }  # fmt: skip
    text = json.dumps(header, sort_keys=True).encode()
    text += b" " * (-len(text) % 4)
    return gzip.compress(b"".join([struct.pack("<I", len(text)), text, *arrays.chunks]), COMPRESSION, mtime=0)


def _add_avatar(arrays: _Arrays, avatar: LinearAvatar) -> None:
    carried = avatar.weights.numpy() > 0
    arrays.bytes_("carriers", carried.sum(1))
    arrays.bytes_("joints_of", avatar.joints_of.numpy()[carried])
    arrays.ranged("weights", avatar.weights.numpy()[carried][:, None], 16)
    arrays.ranged("points", avatar.points.numpy(), 16)
    arrays.ranged("frames", roma.rotmat_to_unitquat(avatar.frames).numpy(), 16)  # xyzw
    arrays.ranged("log_scales", avatar.scales.clamp_min(1e-7).log().numpy(), 8)
    arrays.ranged("color_logit", avatar.color_logit.numpy(), 16)
    bases = len(avatar.signal)
    for name, values, step in (
        ("color_bases", avatar.color_bases, COLOR_STEP),
        ("move_bases", avatar.move_bases, MOVE_STEP),
    ):
        arrays.stepped(name, values.reshape(len(avatar), 3 * bases).T.numpy(), step)
    moved = avatar.expressions.flatten(1).T.numpy()
    arrays.stepped("expression_moves", moved, EXPRESSION_STEP)
    arrays.floats("expressive", avatar.expressive.numpy())  # whole numbers, exact below 16,777,216
    arrays.floats("signal_mean", avatar.signal.mean.numpy())
    arrays.floats("signal_components", avatar.signal.components.numpy())
    arrays.floats("signal_limits", avatar.signal.limits.numpy())
    arrays.floats("joints", avatar.joints.numpy())
    arrays.ranged("trust", avatar.trust[:, None].numpy(), 8)
    arrays.ranged("opacities", avatar.opacities[:, None].numpy(), 16)
    arrays.bytes_("parts", avatar.parts.numpy())


def _add_motion(arrays: _Arrays, name: str, motion: ViewedMotion) -> None:
    arrays.ranged(f"{name}_rotation", motion.rotation.reshape(len(motion), -1), 16)
    arrays.ranged(f"{name}_expression", motion.expression, 16)
    arrays.floats(f"{name}_transl", motion.transl)
    if motion.cameras:
        arrays.floats(f"{name}_cameras", np.stack([camera_row(one) for one in motion.cameras]))


def camera_row(camera: Camera) -> np.ndarray:
    """A camera as the page takes it: fx, fy, cx, cy, width, height, rotation by rows, translation; [18]."""
    lens = camera.intrinsics
    first = torch.tensor([lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], camera.width, camera.height])
    return torch.cat([first, camera.rotation.flatten(), camera.translation]).float().numpy()
