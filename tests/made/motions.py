"""One motion in every form that can be read."""

import json
import math

import numpy as np
import roma
import torch

from pipeline.body import JOINT_NAMES, Poses, joint_index, rest_joints, write_identity, write_poses
from pipeline.clip.camera import facing_camera
from pipeline.clip.keypoints import empty_keypoints, write_keypoints
from pipeline.clip.records import Footage, write_cameras, write_footage
from pipeline.pose_files import into_camera, read_hand_mean
from stages.animate.motions.read import DrivenPerson

FPS = 30.0
FINGERS = ("index", "middle", "pinky", "ring", "thumb")


def made_up(count=7, seed=3):
    """Rotations [T, 55, 3] and the pelvis' way [T, 3] of somebody who turns and walks.

    The first frame is the T pose; the trunk is stiff and so are jaw, eyes and toes: what every form can tell.
    """
    rng = np.random.default_rng(seed)
    rotation = 0.25 * rng.normal(size=(count, 55, 3)) * np.linspace(0, 1, count)[:, None, None]
    for name in ("jaw", "left_eye", "right_eye"):
        rotation[:, joint_index(name)] = 0
    rotation[:, 0] = 0
    rotation[:, 0, 1] = np.linspace(0, 1.2, count)
    way = np.stack([np.linspace(0, 0.5, count), 0.02 * np.sin(np.arange(count)), np.linspace(0, 1, count)], 1)
    return torch.from_numpy(rotation), torch.from_numpy(way - way[0])


def write_npz(path, rotation, way, pivot, layout="poses", z_up=True, **more):
    """AMASS (``poses``, of 156 or 165 numbers) or its SMPL-X release (``parts``)."""
    root, trans = rotation[:, 0], way.clone()
    if z_up:
        turn = roma.rotvec_to_rotmat(torch.tensor([math.pi / 2, 0.0, 0.0], dtype=torch.float64))
        root, trans = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(root)), way @ turn.mT
    count = len(rotation)
    body, face, hands = (
        rotation[:, part].reshape(count, -1) for part in (slice(1, 22), slice(22, 25), slice(25, 55))
    )
    if layout == "parts":
        arrays = {"root_orient": root, "pose_body": body, "pose_hand": hands, "pose_jaw": face[:, :3]}
    else:
        middle = [face] if layout == "poses165" else []
        arrays = {"poses": torch.cat([root, body, *middle, hands], 1)}
    arrays |= {"trans": trans + torch.tensor([5.0, -3.0, 1.0]), "betas": torch.ones(16)}
    named = {name: array.numpy() for name, array in arrays.items()}
    np.savez(path, **named, **{"mocap_framerate": np.array(FPS), "gender": np.array(1), **more})
    return path


def write_folder(folder, rotation, way, pivot, body_file, first=4):
    """A folder of JSON as SMPLest-X's neighbours write it, in a level camera's axes."""
    folder.mkdir()
    mean, camera, count = (
        read_hand_mean(body_file).double(),
        facing_camera(8, 8, 1.0).to(torch.float64),
        len(way),
    )
    root, trans = into_camera(
        rotation[:, 0], way + torch.tensor([0.0, 0.0, -3.0]), pivot,
        camera.rotation.expand(count, 3, 3), camera.translation.expand(count, 3),
    )  # fmt: skip
    for row in range(count):
        hands = rotation[row, 25:55] - mean
        values = {
            "root_pose": root[row], "body_pose": rotation[row, 1:22], "jaw_pose": rotation[row, 22],
            "leye_pose": rotation[row, 23], "reye_pose": rotation[row, 24], "lhand_pose": hands[:15],
            "rhand_pose": hands[15:], "expr": torch.ones(10), "trans": trans[row],
        }  # fmt: skip
        text = json.dumps({name: value.tolist() for name, value in values.items()})
        (folder / f"{first + row}.json").write_text(text)
    return folder


def write_fitted(root, rotation, way, identity, body, expression=None, turned=None, unseen=()):
    """Another subject's ingest and fit; ``turned`` [3, 3] turns its world, cameras and all.

    ``unseen``: slices of the whole-body points that no frame shows.
    """
    folders = {name: root / name for name in ("ingest", "fit")}
    for folder in folders.values():
        folder.mkdir(parents=True)
    frames, joints = tuple(range(0, 2 * len(way), 2)), rest_joints(body, identity).double()
    camera = facing_camera(64, 64, 80.0)
    orient, pelvis = rotation[:, 0], way + torch.tensor([0.1, 0.2, -3.0])
    if turned is not None:
        orient = roma.rotmat_to_rotvec(turned @ roma.rotvec_to_rotmat(orient))
        pelvis = pelvis @ turned.mT
        camera = type(camera)(
            64, 64, camera.intrinsics, camera.rotation @ turned.mT.float(), camera.translation
        )
    whole = torch.cat([orient[:, None], rotation[:, 1:]], 1)
    psi = torch.zeros(len(way), 4) if expression is None else expression
    write_poses(
        folders["fit"] / "poses.parquet", Poses(frames, whole.float(), psi, (pelvis - joints[0]).float())
    )
    write_identity(folders["fit"] / "identity.safetensors", identity, body)
    write_cameras(folders["ingest"] / "cameras.parquet", dict.fromkeys(frames, camera))
    keypoints = empty_keypoints(frames)
    keypoints.whole_body[..., 2] = 1
    for points in unseen:
        keypoints.whole_body[:, points] = 0
    write_keypoints(folders["ingest"] / "keypoints.parquet", keypoints)
    seconds = tuple(row / FPS for row in range(len(way)))
    footage = Footage("clip", 64, 64, 2 * FPS, 1.0, len(way), len(way), {}, 1, seconds, {})
    write_footage(folders["ingest"] / "footage.json", footage)
    return folders


def write_capture(path, rotation, way, person: DrivenPerson, rename=str):
    """A BVH in centimetres whose joints are the body's, by Mixamo's names."""
    joints, parents = 100 * rest_joints(person.body, person.identity).double(), person.body.parents
    kept = [joint for joint, name in enumerate(JOINT_NAMES) if name not in ("jaw", "left_eye", "right_eye")]
    lines, columns = ["HIERARCHY"], []

    def joint_lines(joint, deep):
        pad, name = "  " * deep, rename(mixamo(JOINT_NAMES[joint]))
        offset = joints[joint] - (joints[parents[joint]] if joint else joints[joint])
        places = "6 Xposition Yposition Zposition" if joint == 0 else "3"
        lines.append(f"{pad}{'JOINT' if joint else 'ROOT'} {name}")
        lines.append(f"{pad}{{ OFFSET {offset[0]:.6f} {offset[1]:.6f} {offset[2]:.6f}")
        lines.append(f"{pad}CHANNELS {places} Zrotation Xrotation Yrotation")
        columns.append(joint)
        below = [other for other in kept if parents[other] == joint]
        for other in below:
            joint_lines(other, deep + 1)
        if not below:
            lines.append(f"{pad}End Site {{ OFFSET 0 1 0 }}")
        lines.append(f"{pad}}}")

    joint_lines(0, 0)
    angles = roma.rotmat_to_euler("ZXY", roma.rotvec_to_rotmat(rotation), degrees=True)
    lines += ["MOTION", f"Frames: {len(way)}", f"Frame Time: {1 / FPS:.8f}"]
    for row in range(len(way)):
        numbers = [*(100 * way[row] + joints[0]).tolist(), *angles[row, columns].flatten().tolist()]
        lines.append(" ".join(f"{number:.6f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


def mixamo(name):
    """A joint's name in Mixamo's skeleton."""
    middle = {
        "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck",
        "head": "Head",
    }  # fmt: skip
    sided = {
        "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder",
        "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand",
    }  # fmt: skip
    if name in middle:
        return f"mixamorig:{middle[name]}"
    side, _, part = name.partition("_")
    return f"mixamorig:{side.title()}{sided.get(part) or 'Hand' + part.title()}"
