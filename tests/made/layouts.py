"""Small folders in the layouts of datasets, written from the mannequin as their projects describe them.

Nothing here is imported from ``stages.ingest.datasets``: what is written follows the datasets' conventions,
and a reader that misunderstands one shows the body beside the picture.
"""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tests.made.body import BODY_FILE
from tests.made.layout_footage import SIZE, Footage, Take
from tests.made.videos import write_clip

SMPL_ROOT = np.array([-0.00179505, -0.22333345, 0.02821918])  # SMPL's neutral mean: published, in metres
SMPLX_ROOT = np.array([0.0031, -0.3514, 0.0120])
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # our world (Y up) -> a world whose Z points up


def pictures(folder: Path, images, names) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for image, name in zip(images, names, strict=True):
        stored = (
            image
            if image.ndim == 2
            else cv2.cvtColor(image, cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
        )
        assert cv2.imwrite(str(folder / name), stored)


def put(path: Path, value) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def keypoint_files(folder: Path, points: np.ndarray, numbers) -> Path:
    for row, number in enumerate(numbers):
        put(folder / f"{number}.json", points[row].tolist())
    return folder


def in_camera(shown: Footage, take: Take, row: int) -> tuple[np.ndarray, np.ndarray]:
    """The root's rotation and the root joint in the camera's axes."""
    turn = take.rotation[row]
    return turn @ shown.orient[row], turn @ shown.pelvis[row] + take.translation[row]


def rotvec(matrix: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(matrix).as_rotvec()


def local(shown: Footage, row: int) -> np.ndarray:
    return shown.poses.rotation[row].double().numpy()


def hand_mean(shown: Footage) -> np.ndarray:
    with np.load(BODY_FILE) as archive:
        return np.concatenate([archive["hands_meanl"].reshape(15, 3), archive["hands_meanr"].reshape(15, 3)])


def smplx_json(shown: Footage, take: Take, row: int, root: np.ndarray) -> dict:
    """ExAvatar's parameters: the root in the camera, trans relative to the root joint at rest (A3)."""
    turn, pelvis = in_camera(shown, take, row)
    angles = local(shown, row)
    hands = angles[25:] - hand_mean(shown)
    return {
        "root_pose": rotvec(turn).tolist(), "body_pose": angles[1:22].tolist(),
        "jaw_pose": angles[22].tolist(), "leye_pose": angles[23].tolist(), "reye_pose": angles[24].tolist(),
        "lhand_pose": hands[:15].tolist(), "rhand_pose": hands[15:].tolist(),
        "expr": np.pad(shown.poses.expression[row].double().numpy(), (0, 50))[:50].tolist(),
        "trans": (pelvis - root).tolist(),
    }  # fmt: skip


def optimized(folder: Path, shown: Footage, take: Take, numbers, names=("smplx_params",)) -> None:
    """smplx_optimized/: parameters, shape, offsets. Their joints follow face offsets, ours do not (0, A2)."""
    fitted = folder / "smplx_optimized"
    bare = shown.identity
    followed = (shown.body.joint_regressor @ bare.face_offset).double().numpy()
    offset = bare.joint_offset.double().numpy() - followed
    theirs = shown.root - offset[0]  # the root has no offset there
    offset[0] = 0
    for name in names:
        for row, number in enumerate(numbers):
            value = smplx_json(shown, take, row, theirs)
            # The pelvis turns about another point than ours: place it so that the body is the same.
            turn, pelvis = in_camera(shown, take, row)
            value["trans"] = (pelvis + turn @ (theirs - shown.root) - theirs).tolist()
            put(fitted / name / f"{number}.json", value)
    put(fitted / "shape_param.json", bare.betas.tolist())
    put(fitted / "joint_offset.json", offset.tolist())
    put(fitted / "face_offset.json", bare.face_offset.tolist())
    put(fitted / "body.json", {"body": shown.body.digest})


def prepared(folder: Path, shown: Footage, lists: dict[str, list[int]], first: int = 0) -> Path:
    """Custom: frames/<idx>.png, masks, cam_params, keypoints, smplx_optimized, frame lists."""
    take = shown.still
    numbers = [first + row for row in range(len(take.images))]
    pictures(folder / "frames", take.images, [f"{n}.png" for n in numbers])
    pictures(folder / "masks", take.masks, [f"{n}.png" for n in numbers])
    keypoint_files(folder / "keypoints_whole_body", take.keypoints, numbers)
    focal, centre = take.matrix.diagonal()[:2].tolist(), take.matrix[:2, 2].tolist()
    for n in numbers:  # the virtual camera: its axes are the world
        put(folder / "cam_params" / f"{n}.json",
            {"R": np.eye(3).tolist(), "t": [0, 0, 0], "focal": focal, "princpt": centre})  # fmt: skip
    optimized(folder, shown, take, numbers, ("smplx_params", "smplx_params_smoothed"))
    for name, frames in lists.items():
        (folder / f"frame_list_{name}.txt").write_text("".join(f"{n}\n" for n in frames))
    return folder


def neuman(folder: Path, shown: Footage, unit: float, fitted: bool) -> Path:
    """images/%05d.png, segmentations (255 is background), sparse in its own unit and axes, split files."""
    take, names = shown.moving, [f"{row:05d}.png" for row in range(len(shown.moving.images))]
    pictures(folder / "images", take.images, names)
    pictures(folder / "segmentations", 255 - take.masks, names)
    turn = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()  # COLMAP's world is turned any way
    sparse = folder / "sparse"
    sparse.mkdir(parents=True)
    k = take.matrix
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {SIZE} {SIZE} {k[0, 0]} {k[1, 1]} {k[0, 2]} {k[1, 2]}\n")
    lines = []
    for row, name in enumerate(names):
        rotation = take.rotation[row] @ turn.T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        tx, ty, tz = take.translation[row] / unit
        lines.append(f"{row + 1} {w} {x} {y} {z} {tx} {ty} {tz} 1 {name}\n\n")
    (sparse / "images.txt").write_text("".join(lines))
    (sparse / "points3D.txt").write_text("")
    for part, chosen in (("train", names[:4]), ("val", names[4:5]), ("test", names[5:])):
        (folder / f"{part}_split.txt").write_text("".join(f"{name}\n" for name in chosen))
    if fitted:
        optimized(folder, shown, take, range(len(names)))
    return folder


def distorted(image: np.ndarray, matrix: np.ndarray, bend: np.ndarray, how: int) -> np.ndarray:
    """The picture that a lens with OpenCV's distortion takes of what a pinhole took."""
    rows, columns = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    where = cv2.undistortPoints(pixels, matrix, bend, P=matrix).reshape(SIZE, SIZE, 2).astype(np.float32)
    return cv2.remap(image, where[..., 0], where[..., 1], how, borderMode=cv2.BORDER_REPLICATE)


def zju(folder: Path, shown: Footage, bend: np.ndarray, refined: bool = True) -> Path:
    """annots.npy with K, D, R, T in mm, a world whose Z is up, SMPL about the origin; every fifth frame.

    ``refined``: as GauHuman reads it, images/00 with mask/00 and smpl_params; otherwise neuralbody's original
    release, Camera_B1 with mask_cihp/Camera_B1 (labels of body parts) and new_params.
    """
    cams: dict[str, list] = {"K": [], "D": [], "R": [], "T": []}
    names = ["images/00", "images/01", "images/02"] if refined else ["Camera_B1", "Camera_B2", "Camera_B3"]
    masks_of, poses_of = ("mask", "smpl_params") if refined else ("mask_cihp", "new_params")
    for take, name in zip(shown.rig, names, strict=True):
        matrix = take.matrix.copy()
        matrix[:2, 2] -= 0.5  # OpenCV counts from the first pixel's centre
        cams["K"].append(matrix)
        cams["D"].append(bend.reshape(5, 1))
        cams["R"].append(take.rotation[0] @ Z_UP.T)
        cams["T"].append(1000 * take.translation[0].reshape(3, 1))
        files = [f"{5 * row:06d}" for row in range(len(take.images))]
        images = [distorted(one, matrix, bend, cv2.INTER_LINEAR) for one in take.images]
        masks = [distorted(one, matrix, bend, cv2.INTER_LINEAR) for one in take.masks]
        labels = [(m > 127).astype(np.uint8) * (1 if refined else 5) for m in masks]
        pictures(folder / name, images, [f"{file}.jpg" for file in files])
        pictures(folder / masks_of / name.removeprefix("images/"), labels, [f"{f}.png" for f in files])
    count = 5 * (len(shown.still.images) - 1) + 1
    ims = [{"ims": [f"{name}/{frame:06d}.jpg" for name in names]} for frame in range(count)]
    np.save(folder / "annots.npy", {"cams": cams, "ims": ims}, allow_pickle=True)
    (folder / poses_of).mkdir()
    for row in range(len(shown.still.images)):
        turn = Z_UP @ shown.orient[row]
        place = Z_UP @ shown.pelvis[row] - turn @ SMPL_ROOT
        value = {
            "Rh": rotvec(turn).reshape(1, 3), "Th": place.reshape(1, 3), "shapes": np.zeros((1, 10)),
            "poses": smpl72(shown, row, np.zeros(3)).reshape(1, 72),
        }  # fmt: skip
        np.save(folder / poses_of / f"{5 * row}.npy", value, allow_pickle=True)
    return folder


def smpl72(shown: Footage, row: int, root: np.ndarray) -> np.ndarray:
    """SMPL's 72 numbers: root, 21 body joints, two hands as one piece."""
    return np.concatenate([root, local(shown, row)[1:22].ravel(), np.zeros(6)])


def wildavatar(folder: Path, shown: Footage) -> Path:
    """metadata.json: intrinsics, extrinsics 4x4, 72 poses and 10 betas a frame; the body at its origin."""
    take, table = shown.moving, {}
    for row in range(len(take.images)):
        _, pelvis = in_camera(shown, take, row)
        extrinsics = np.eye(4)
        extrinsics[:3, :3] = take.rotation[row]
        extrinsics[:3, 3] = pelvis - take.rotation[row] @ SMPL_ROOT
        table[f"{row:06d}"] = {
            "cam_intrinsics": take.matrix.tolist(), "cam_extrinsics": extrinsics.tolist(),
            "poses": smpl72(shown, row, rotvec(shown.orient[row])).tolist(), "betas": [0.0] * 10,
        }  # fmt: skip
    put(folder / "metadata.json", {**table, "start": 12.5})
    names = [f"{row:06d}.png" for row in range(len(take.images))]
    pictures(folder / "images", take.images, names)
    pictures(folder / "masks", take.masks, names)
    return folder


def talkshow(folder: Path, shown: Footage, pickled: bool = True, listed: bool = False) -> Path:
    """<seq>.mp4 and SHOW's <seq>.pkl with torch tensors, in a list if ``listed``; hands are 12 PCA numbers.

    PyTorch3D's x and y point the other way: x and y of camera_transl are the negative of OpenCV's.
    """
    take, count = shown.still, len(shown.still.images)
    folder.mkdir(parents=True, exist_ok=True)
    write_clip(folder / "212-00_00_00.mp4", take.images)
    if not pickled:
        return folder
    angles = np.stack([local(shown, row) for row in range(count)])
    camera_transl = np.array([0.3, -0.2, 4.0])
    in_opencv = np.array([-0.3, 0.2, 4.0])
    places = np.stack([in_camera(shown, take, row)[1] for row in range(count)])
    table = {
        "width": SIZE, "height": SIZE, "center": torch.tensor(take.matrix[:2, 2]), "batch_size": count,
        "camera_transl": torch.tensor(camera_transl), "focal_length": float(take.matrix[0, 0]),
        "global_orient": torch.tensor(
            np.stack([rotvec(in_camera(shown, take, row)[0]) for row in range(count)])[:, None]),
        "body_pose_axis": torch.tensor(angles[:, 1:22].reshape(count, 63)),
        "jaw_pose": torch.tensor(angles[:, 22]), "leye_pose": torch.tensor(angles[:, 23]),
        "reye_pose": torch.tensor(angles[:, 24]), "expression": torch.zeros(count, 100),
        "betas": torch.zeros(1, 300), "transl": torch.tensor(places - shown.root - in_opencv),
        "left_hand_pose": torch.zeros(count, 12), "right_hand_pose": torch.zeros(count, 12),
        "pose_embedding": torch.zeros(count, 32),
    }  # fmt: skip
    (folder / "212-00_00_00.pkl").write_bytes(pickle.dumps([table] if listed else table))
    return folder


def head_camera(shown: Footage, row: int) -> tuple[np.ndarray, np.ndarray]:
    """INSTA's world is the head's own: world-to-camera of the still camera in it."""
    return in_camera(shown, shown.still, row)


def insta(folder: Path, shown: Footage, axes: str = "opencv", texts: bool = False) -> Path:
    """RGBA images, transforms*.json (camera-to-world), and the tracker's checkpoint/*.frame torch files.

    scripts/transforms.py inverts the tracker's opencv R, t and leaves its axes; frames stand in the order in
    which its processes finished. ``texts``: flame/{exp,jaw,eyes}/*.txt in the place of checkpoint/.
    """
    take, count = shown.still, len(shown.still.images)
    numbers = list(range(1, count + 1))
    rgba = [np.dstack([take.images[row], take.masks[row]]) for row in range(count)]
    pictures(folder / "images", rgba, [f"{n:05d}.png" for n in numbers])
    (folder / "checkpoint").mkdir()
    flip = np.diag([1.0, 1.0, 1.0, 1.0] if axes == "opencv" else [1.0, -1.0, -1.0, 1.0])
    frames = []
    for row, n in enumerate(numbers):
        turn, shift = head_camera(shown, row)
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = turn, shift
        c2w = np.linalg.inv(view) @ flip
        frames.append({"file_path": f"images/{n:05d}.png", "transform_matrix": c2w.tolist(),
                       "exp_path": f"flame/exp/{n:05d}.txt", "mesh_path": f"meshes/{n:05d}.obj"})  # fmt: skip
        angles = local(shown, row)
        six = [Rotation.from_rotvec(angles[joint]).as_matrix()[:2].ravel() for joint in (22, 23, 24)]
        value = {
            "flame": {"exp": np.full((1, 100), 0.01 * n, np.float32), "shape": np.zeros((1, 300), np.float32),
                      "jaw": six[0][None].astype(np.float32), "eyelids": np.zeros((1, 2), np.float32),
                      "eyes": np.concatenate(six[1:])[None].astype(np.float32)},
            "opencv": {"R": turn[None].astype(np.float32), "t": shift[None].astype(np.float32),
                       "K": take.matrix[None].astype(np.float32)},
            "camera": {"R": torch.eye(3)[None], "t": torch.zeros(1, 3)},
            "img_size": np.array([SIZE, SIZE]), "frame_id": f"{n:05d}",
        }  # fmt: skip
        if not texts:
            torch.save(value, folder / "checkpoint" / f"{n:05d}.frame")
            continue
        for key in ("exp", "jaw", "eyes"):
            (folder / "flame" / key).mkdir(parents=True, exist_ok=True)
            np.savetxt(folder / "flame" / key / f"{n:05d}.txt", value["flame"][key][0], fmt="%.8f")
    if texts:
        (folder / "checkpoint").rmdir()
    k = take.matrix
    common = {"cx": k[0, 2], "cy": k[1, 2], "fl_x": k[0, 0], "fl_y": k[1, 1], "w": SIZE, "h": SIZE,
              "camera_angle_x": 2 * float(np.arctan(SIZE / 2 / k[0, 0]))}  # fmt: skip
    for part, chosen in (("", frames), ("_train", frames[:4]), ("_test", frames[4:])):
        put(folder / f"transforms{part}.json", {**common, "frames": chosen[::-1]})
    return folder


def xhumans(folder: Path, shown: Footage, first: int = 1) -> Path:
    """render/image, render/cameras.npz, SMPLX pickles in the world, whose Z is up here.

    Pictures are counted from 1, the meshes from ``first``; the pickles' betas are not to be used.
    """
    take, count = shown.moving, len(shown.moving.images)
    numbers = list(range(1, count + 1))
    pictures(folder / "render" / "image", take.images, [f"color_{n:06d}.png" for n in numbers])
    keypoint_files(folder / "render" / "keypoints_whole_body", take.keypoints, numbers)
    extrinsic = np.stack(
        [
            np.vstack([np.column_stack([take.rotation[r] @ Z_UP.T, take.translation[r]]), [0, 0, 0, 1.0]])
            for r in range(count)
        ]
    )
    np.savez(folder / "render" / "cameras.npz", intrinsic=take.matrix, extrinsic=extrinsic)
    (folder / "SMPLX").mkdir()
    for row, n in enumerate(numbers):
        angles = local(shown, row)
        hands = (angles[25:] - hand_mean(shown)).reshape(2, 45)
        value = {
            "global_orient": rotvec(Z_UP @ shown.orient[row]), "body_pose": angles[1:22].ravel(),
            "jaw_pose": angles[22], "leye_pose": angles[23], "reye_pose": angles[24],
            "left_hand_pose": hands[0], "right_hand_pose": hands[1], "expression": np.zeros(10),
            "betas": np.full(10, 0.1 * n), "transl": Z_UP @ shown.pelvis[row] - SMPLX_ROOT,
        }  # fmt: skip
        (folder / "SMPLX" / f"mesh-f{first + row:05d}_smplx.pkl").write_bytes(pickle.dumps(value))
    return folder


def persona(folder: Path, shown: Footage) -> Path:
    """captured/ and test/ in the naming of prepared folders, but images/ and a list; and a generated clip."""
    for name, chosen in (("captured", slice(0, 4)), ("test", slice(4, 6)), ("generated_0", slice(0, 2))):
        take = shown.still.rows(chosen)
        numbers = list(range(len(take.images)))
        pictures(folder / name / "images", take.images, [f"{n}.png" for n in numbers])
        pictures(folder / name / "masks", take.masks, [f"{n}.png" for n in numbers])
        keypoint_files(folder / name / "keypoints_whole_body", take.keypoints, numbers)
        focal, centre = take.matrix.diagonal()[:2].tolist(), take.matrix[:2, 2].tolist()
        for n, row in zip(numbers, range(chosen.start, chosen.stop), strict=True):
            put(folder / name / "cam_params" / f"{n}.json",
                {"R": np.eye(3).tolist(), "t": [0, 0, 0], "focal": focal, "princpt": centre})  # fmt: skip
            value = smplx_json(shown, shown.still, row, shown.root)
            put(folder / name / "smplx_optimized" / "smplx_params" / f"{n}.json", value)
        (folder / name / "frame_idx_list.txt").write_text("".join(f"{n}\n" for n in numbers))
    return folder


def pose2sim(folder: Path, shown: Footage) -> Path:
    """videos/ and calibration/Calib.toml: a world whose Z is up, metres, OpenCV's pixels."""
    text = []
    for place, take in enumerate(shown.rig, start=1):
        (folder / "videos").mkdir(parents=True, exist_ok=True)
        write_clip(folder / "videos" / f"cam{place:02d}.mp4", take.images)
        matrix = take.matrix.copy()
        matrix[:2, 2] -= 0.5
        turn = rotvec(take.rotation[0] @ Z_UP.T)
        text.append(
            f'[cam_{place:02d}]\nname = "cam_{place:02d}"\nsize = [{SIZE}.0, {SIZE}.0]\n'
            f"matrix = {matrix.tolist()}\ndistortions = [0.0, 0.0, 0.0, 0.0]\n"
            f"rotation = {turn.tolist()}\ntranslation = {take.translation[0].tolist()}\nfisheye = false\n"
        )
    (folder / "calibration").mkdir()
    (folder / "calibration" / "Calib.toml").write_text("\n".join(text) + "\n[metadata]\nadjusted = false\n")
    return folder
