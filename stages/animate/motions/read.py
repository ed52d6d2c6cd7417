"""Reading a motion of any kind that ``motion=`` names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from pipeline.body import JOINT_NAMES, BodyModel, Identity, rest_joints
from pipeline.clip.frames import spread_end_to_end
from pipeline.config.choices import Up
from pipeline.motion.bvh import read_bvh
from pipeline.motion.retarget import retarget_rows
from stages.animate.motions.amass import read_amass
from stages.animate.motions.fitted_motion import read_fitted
from stages.animate.motions.motion import Motion, Span, leg_length
from stages.animate.motions.pose_folder import read_pose_folder
from stages.animate.motions.source import MotionSource

_REFERENCE_FRAMES = 500  # among which the one with the straightest limbs is sought


@dataclasses.dataclass(frozen=True)
class DrivenPerson:
    """The person that a motion is given to.

    Attributes:
        body: the body model.
        body_file: its file.
        identity: the person's.
    """

    body: BodyModel
    body_file: Path
    identity: Identity


def read_motion(
    name: MotionSource, person: DrivenPerson, span: Span, up: Up, folders: Mapping[str, Path]
) -> Motion:
    """Reads a motion; not a turntable, which is none.

    Args:
        name: what it is.
        person: who is to be moved by it.
        span: which frames are wanted.
        up: the axis that is up in a .bvh or an .npz, or auto.
        folders: the other subject's results, if it is one.

    Raises:
        UserError: it cannot be read; names the file and the remedy.
    """
    if name.subject:
        return read_fitted(name.subject, folders, person.body, span)
    assert name.path is not None
    if name.kind == "bvh":
        return read_capture(name.path, person, span, up)
    if name.kind == "amass":
        return read_amass(name.path, person.body, span, up)
    return read_pose_folder(name.path, person.body, person.body_file, span)


def read_capture(path: Path, person: DrivenPerson, span: Span, up: Up = "auto") -> Motion:
    """Reads a BVH file and carries it over, see ``retarget``.

    Raises:
        UserError: it is no BVH, its joints are not known by name, or no frame is in the span.
    """
    bvh = read_bvh(path)
    rows, fps = span.rows(len(bvh.values), bvh.fps, path.name)
    reference = np.array(spread_end_to_end(range(len(bvh.values)), _REFERENCE_FRAMES), np.int64)
    joints = rest_joints(person.body, person.identity)
    carried = retarget_rows(bvh, joints, person.body.parents, rows, reference, up, str(path))
    return Motion(
        name=path.name,
        fps=fps,
        numbers=tuple(rows.tolist()),
        rotation=carried.rotation,
        expression=None,
        root=carried.root,
        leg=leg_length(person.body, identity=person.identity),
        told=carried.told,
        unused=carried.unused,
        notes=(f"{path.name}: {carried.note}",),
    )


def with_relaxed_hands(motion: Motion, mean: torch.Tensor) -> Motion:
    """Fingers that the motion tells nothing of hang relaxed instead of flat.

    Args:
        motion: as it was read.
        mean: [30, 3], the body's mean hands, see ``pose_files.read_hand_mean``.
    """
    fingers = JOINT_NAMES[len(JOINT_NAMES) - len(mean) :]
    untold = [joint for joint in fingers if joint not in motion.told]
    if not untold:
        return motion
    rotation = motion.rotation.clone()
    for joint in untold:
        rotation[:, JOINT_NAMES.index(joint)] = mean[fingers.index(joint)]
    return dataclasses.replace(motion, rotation=rotation)
