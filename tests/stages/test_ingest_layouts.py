"""Every dataset's layout, written from the mannequin in its own convention and read back.

What comes out of the ingest stage must put the true body where the picture has it: joints within pixels,
silhouettes over one another. Each flipped axis, wrong unit or exchanged pivot shows there.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.clip.camera import Camera, project
from pipeline.clip.frames import read_frame, read_mask
from pipeline.clip.keypoints import read_keypoints
from pipeline.clip.records import SHOT_STEP, read_cameras, read_footage, read_split
from pipeline.errors import UserError
from pipeline.pose_files import INITIAL_POSES, read_initial_poses, with_flat_hands
from stages.fit.camera_batch import stack
from stages.fit.initialise_from_poses import keep_given
from stages.ingest.datasets.neuman import official_split
from stages.ingest.run import run
from tests.made import layouts as writers
from tests.made.body import BODY_FILE
from tests.made.layout_footage import COUNT, FEW, SIZE, Take, footage, joints_and_surface, silhouette
from tests.made.videos import ingest_context

STILL_STEPS = range(COUNT)


@pytest.fixture(scope="module")
def shown():
    return footage()


def ingest(tmp_path: Path, source: Path, **settings) -> Path:
    context = ingest_context(tmp_path / "run", source, **settings)
    run(context)
    return context.output


def points(tmp_path: Path, take: Take, numbers) -> str:
    """A folder of true keypoints for layouts that bring none."""
    return str(writers.keypoint_files(tmp_path / "points", take.keypoints, numbers))


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    return float((first & second).sum() / max((first | second).sum(), 1))


def check_body(output: Path, shown, rows: dict[int, int], pixels: float, place=None) -> None:
    """The true body in the poses and cameras that were read lands on the pictures that were read.

    Args:
        rows: frame number -> row of the motion.
        pixels: how far joints may lie from the truth, mean.
        place: ``transl`` for layouts that have none.
    """
    cameras = read_cameras(output / "cameras.parquet", torch.float64)
    start = with_flat_hands(read_initial_poses(output / INITIAL_POSES), BODY_FILE, False)
    if place is not None:
        start = dataclasses.replace(start, transl=torch.from_numpy(place).float())
    start = dataclasses.replace(
        start, betas=None if start.joint_offset is None else start.betas, expression=None
    )
    views = stack([cameras[frame] for frame in start.frames])
    identity, poses = keep_given(start, shown.body, views)
    pivot = (identity_root(shown, identity) - torch.from_numpy(shown.root)).float()
    # The body that is posed is the true one; only the place of its root joint is taken.
    wanted = list(rows)
    joints, surface = joints_and_surface(
        shown, dataclasses.replace(poses, transl=poses.transl + pivot), [poses.index(f) for f in wanted]
    )
    truth, true_surface = joints_and_surface(shown, shown.poses, [rows[frame] for frame in wanted])
    for place_, frame in enumerate(wanted):
        camera = cameras[frame]
        mask = read_mask(output / "masks", frame) > 127
        found = project(camera, torch.from_numpy(joints[place_][:22])).numpy()
        expected = true_pixels(shown, camera, frame, rows[frame], truth[place_][:22], output)
        assert np.linalg.norm(found - expected, axis=1).mean() < pixels, frame
        seen = silhouette(surface[place_], shown.body.faces.numpy(), camera)
        assert overlap(seen, mask) > 0.82, (frame, overlap(seen, mask))


def identity_root(shown, identity) -> torch.Tensor:
    from pipeline.body import rest_joints

    return rest_joints(shown.body, identity)[0].double()


TAKES: dict[str, Take] = {}


def true_pixels(shown, camera: Camera, frame: int, row: int, joints: np.ndarray, output: Path) -> np.ndarray:
    """Where the joints are in the picture, from the camera that took it and not from what was read."""
    take = TAKES[str(output)]
    if isinstance(take, dict):
        take, row_of_take = take[frame]
    else:
        row_of_take = row
    there = joints @ take.rotation[row_of_take].T + take.translation[row_of_take]
    return ((there / there[:, 2:]) @ take.matrix.T)[:, :2]


def expect(output: Path, take) -> None:
    TAKES[str(output)] = take


def check_cameras(output: Path, rotation, translation, matrix, frames, tolerance=1e-4, scale=None) -> None:
    """The cameras that were read are those that were written, up to the choice of the world."""
    cameras = read_cameras(output / "cameras.parquet", torch.float64)
    first = frames[0]
    for row, frame in enumerate(frames):
        camera = cameras[frame]
        np.testing.assert_allclose(camera.intrinsics.numpy(), matrix, atol=1e-3)
        for found, a, b in ((camera, rotation[row], translation[row]),):
            start = cameras[first]
            turn = found.rotation @ start.rotation.mT
            true_turn = a @ rotation[0].T
            np.testing.assert_allclose(turn.numpy(), true_turn, atol=tolerance)
            shift = found.translation - turn @ start.translation
            true_shift = b - true_turn @ translation[0]
            if scale is not None:
                true_shift = true_shift * scale
            np.testing.assert_allclose(shift.numpy(), true_shift, atol=10 * tolerance)


def same_pictures(output: Path, take: Take, frames, exact: bool = True) -> None:
    for row, frame in enumerate(frames):
        image, mask = read_frame(output / "frames", frame), read_mask(output / "masks", frame)
        if exact:
            np.testing.assert_array_equal(image, take.images[row])
            np.testing.assert_array_equal(mask, take.masks[row])
        else:
            inner = (slice(6, -6), slice(6, -6))
            assert np.abs(image[inner].astype(int) - take.images[row][inner].astype(int)).mean() < 8
            assert overlap(mask > 127, take.masks[row] > 127) > 0.93


@pytest.mark.parametrize("fitted", [False, True])
def test_neuman(tmp_path, shown, fitted):
    folder = writers.neuman(tmp_path / "bike", shown, unit=0.4, fitted=fitted)
    take = shown.moving
    settings = {"keypoints": points(tmp_path, take, range(COUNT)), "camera_scale": 0.4}
    output = ingest(tmp_path, folder, **settings)
    expect(output, take)
    same_pictures(output, take, range(COUNT))
    check_cameras(output, take.rotation, take.translation, take.matrix, range(COUNT))
    split = read_split(output / "split.json")
    assert split.train == (0, 1, 2, 3) and split.test == (5,)  # frame 4 is for validation
    assert (output / INITIAL_POSES).exists() == fitted
    if fitted:
        check_body(output, shown, {0: 0, 3: 3, 5: 5}, 0.05)


def test_neuman_scale_comes_from_the_fitted_poses(tmp_path, shown):
    folder = writers.neuman(tmp_path / "bike", shown, unit=0.4, fitted=True)
    output = ingest(tmp_path, folder, keypoints=points(tmp_path, shown.moving, range(COUNT)))
    assert read_footage(output / "footage.json").camera["metres_per_unit"] == pytest.approx(0.4, rel=0.1)


def test_neuman_split_rule():
    train, test = official_split(range(104))
    assert len(test) == 10 and len(train) == 104 - 21 and min(test) == 2
    assert official_split(range(3)) == (frozenset(range(3)), frozenset())


@pytest.mark.parametrize("bend", [np.zeros(5), np.array([-0.25, 0.1, 0.002, -0.003, 0.05])])
def test_zju_as_one_video(tmp_path, shown, bend):
    folder = writers.zju(tmp_path / "my_377", shown, bend)
    frames = [5 * row for row in range(COUNT)]
    for extra in set(range(frames[-1] + 1)) - set(frames):  # every frame is read as a video
        for kind in ("images/00", "mask/00"):
            suffix = "png" if kind.startswith("mask") else "jpg"
            source = folder / kind / f"{extra // 5 * 5:06d}.{suffix}"
            (folder / kind / f"{extra:06d}.{suffix}").write_bytes(source.read_bytes())
    numbers = range(frames[-1] + 1)
    known = [n // 5 for n in numbers]
    take = shown.still
    whole = dataclasses.replace(take, keypoints=take.keypoints[known])
    output = ingest(
        tmp_path, folder, camera_name="0", keypoints=points(tmp_path, whole, numbers), test_frames=4
    )
    expect(output, {frame: (take, frame // 5) for frame in numbers})
    same_pictures(output, take, frames, exact=False)
    check_cameras(output, take.rotation, take.translation, take.matrix, frames)
    assert read_split(output / "split.json").test == (22, 23, 24, 25)
    check_body(output, shown, {0: 0, 10: 2, 25: 5}, 0.3)


def test_zju_as_gauhuman_reads_it(tmp_path, shown):
    folder = writers.zju(tmp_path / "my_377", shown, np.zeros(5))
    train = [5 * row for row in range(COUNT)]
    test = [SHOT_STEP, 2 * SHOT_STEP]
    folder_of_points = points(tmp_path, shown.still, train)
    for place, number in enumerate(test, start=1):
        writers.keypoint_files(Path(folder_of_points), shown.rig[place].keypoints, [number])
    output = ingest(tmp_path, folder, camera_name="0", test_cameras=("others",), keypoints=folder_of_points)
    split = read_split(output / "split.json")
    assert list(split.train) == train and list(split.test) == test
    takes = {
        **{f: (shown.still, f // 5) for f in train},
        **{n: (shown.rig[i], 0) for i, n in enumerate(test, 1)},
    }
    expect(output, takes)
    rotation = np.stack([takes[f][0].rotation[takes[f][1]] for f in train + test])
    translation = np.stack([takes[f][0].translation[takes[f][1]] for f in train + test])
    check_cameras(output, rotation, translation, shown.still.matrix, train + test)
    # The held-out cameras see the same body at the same moment.
    check_body(output, shown, {0: 0, 25: 5, SHOT_STEP: 0, 2 * SHOT_STEP: 0}, 0.3)


def test_wildavatar(tmp_path, shown):
    folder = writers.wildavatar(tmp_path / "a1B2", shown)
    take = shown.moving
    output = ingest(tmp_path, folder, keypoints=points(tmp_path, take, range(COUNT)), test_frames=2)
    expect(output, take)
    same_pictures(output, take, range(COUNT))
    metadata = json.loads((folder / "metadata.json").read_text())
    extrinsics = np.stack([np.array(metadata[f"{row:06d}"]["cam_extrinsics"]) for row in range(COUNT)])
    check_cameras(output, extrinsics[:, :3, :3], extrinsics[:, :3, 3], take.matrix, range(COUNT))
    check_body(output, shown, {0: 0, 2: 2, 5: 5}, 0.3)


def test_talkshow(tmp_path, shown):
    folder = writers.talkshow(tmp_path / "clip", shown)
    masks = tmp_path / "masks"
    writers.pictures(masks, shown.still.masks, [f"{row}.png" for row in range(COUNT)])
    settings = {"keypoints": points(tmp_path, shown.still, range(COUNT)), "masks": str(masks)}
    output = ingest(tmp_path, folder, test_frames=2, **settings)
    expect(output, shown.still)
    same_pictures(output, shown.still, range(COUNT), exact=False)
    check_cameras(output, shown.still.rotation, shown.still.translation, shown.still.matrix, range(COUNT))
    check_body(output, shown, {0: 0, 3: 3}, 0.3)
    record = read_initial_poses(output / INITIAL_POSES)
    assert record.hand_pca.shape == (COUNT, 2, 12) and record.expression.shape == (COUNT, 100)
    alone = ingest(
        tmp_path / "alone", writers.talkshow(tmp_path / "b", shown, False), layout="talkshow", **settings
    )
    assert not (alone / INITIAL_POSES).exists()  # without SHOW's .pkl the clip is a clip


def test_insta(tmp_path, shown):
    folder = writers.insta(tmp_path / "bala", shown)
    take, frames = shown.still, range(1, COUNT + 1)
    output = ingest(tmp_path, folder, keypoints=points(tmp_path, take, frames))
    expect(output, {frame: (take, frame - 1) for frame in frames})
    same_pictures(output, take, frames)
    heads = [writers.head_camera(shown, row) for row in range(COUNT)]
    check_cameras(output, *(np.stack(part) for part in zip(*heads, strict=True)), take.matrix, frames)
    assert read_split(output / "split.json").test == (5, 6)
    record = read_initial_poses(output / INITIAL_POSES)
    truth = shown.poses.rotation[:, 22:25].double().numpy()
    np.testing.assert_allclose(record.rotation[:, 22:25].numpy(), truth, atol=1e-4)
    np.testing.assert_allclose(record.expression[:, 3].numpy(), 0.01 * np.array(frames), atol=1e-6)
    place = np.stack([head[1] - shown.root for head in heads])
    rotation = record.rotation.clone()
    rotation[:, 1:22] = shown.poses.rotation[:, 1:22]  # FLAME knows nothing of the body
    from pipeline.pose_files import write_initial_poses

    write_initial_poses(output / INITIAL_POSES, dataclasses.replace(record, rotation=rotation))
    check_body(output, shown, {1: 0, 4: 3}, 0.1, place)


def test_insta_from_the_trackers_files_alone(tmp_path, shown):
    folder = writers.insta(tmp_path / "bala", shown)
    for path in folder.glob("transforms*.json"):
        path.unlink()
    frames = range(1, COUNT + 1)
    output = ingest(tmp_path, folder, keypoints=points(tmp_path, shown.still, frames), test_frames=2)
    check_cameras(output, shown.still.rotation, shown.still.translation, shown.still.matrix, frames)


def test_prepared_folder(tmp_path, shown):
    every = list(range(COUNT))
    folder = writers.prepared(tmp_path / "me", shown, {"all": every, "train": every[:4], "test": every[4:]})
    output = ingest(tmp_path, folder)
    expect(output, shown.still)
    same_pictures(output, shown.still, every)
    check_cameras(output, shown.still.rotation, shown.still.translation, shown.still.matrix, every)
    assert read_split(output / "split.json").test == (4, 5)
    np.testing.assert_allclose(
        read_keypoints(output / "keypoints.parquet").whole_body[2, :17],
        shown.still.keypoints[2, :17],
        atol=1e-3,
    )
    check_body(output, shown, {0: 0, 3: 3, 5: 5}, 0.05)
    record = read_initial_poses(output / INITIAL_POSES)
    assert record.fitted and record.model == shown.body.digest
    views = stack([read_cameras(output / "cameras.parquet")[frame] for frame in every])
    identity, poses = keep_given(with_flat_hands(record, BODY_FILE, False), shown.body, views)
    np.testing.assert_allclose(identity.joint_offset[1:], shown.identity.joint_offset[1:], atol=1e-5)
    np.testing.assert_allclose(identity.face_offset, shown.identity.face_offset, atol=1e-6)
    turn = Rotation.from_rotvec(poses.rotation[:, 25:].reshape(-1, 3).numpy()).inv()
    truth = Rotation.from_rotvec(shown.poses.rotation[:, 25:].reshape(-1, 3).numpy())
    assert (turn * truth).magnitude().max() < 1e-3


def test_prepared_lists_that_hold_nothing_out(tmp_path, shown):
    every = list(range(COUNT))
    folder = writers.prepared(
        tmp_path / "me", shown, {"all": every[1:], "train": every[1:], "test": every[1:]}
    )
    split = read_split(ingest(tmp_path, folder, test_frames=1) / "split.json")
    assert split.train == (1, 2, 3, 4) and split.test == (5,)


def test_generated_folder(tmp_path, shown):
    numbers = list(range(100_000, 100_000 + COUNT))
    folder = writers.prepared(tmp_path / "me_gen", shown, {"train": numbers}, first=100_000)
    split = read_split(ingest(tmp_path, folder) / "split.json")
    assert list(split.train) == numbers and split.test == ()


def test_xhumans(tmp_path, shown):
    folder = writers.xhumans(tmp_path / "Take15", shown)
    take, frames = shown.moving, range(1, COUNT + 1)
    masks = tmp_path / "masks"
    writers.pictures(masks, take.masks, [f"{n}.png" for n in frames])
    output = ingest(tmp_path, folder, masks=str(masks))
    expect(output, {frame: (take, frame - 1) for frame in frames})
    same_pictures(output, take, frames)
    check_cameras(output, take.rotation, take.translation, take.matrix, frames)
    check_body(output, shown, {1: 0, 3: 2, 6: 5}, 0.3)


def test_persona(tmp_path, shown):
    output = ingest(tmp_path, writers.persona(tmp_path / "someone", shown))
    split = read_split(output / "split.json")
    assert split.train == (0, 1, 2, 3) and split.test == (SHOT_STEP, SHOT_STEP + 1)
    expect(
        output,
        {
            **{n: (shown.still, n) for n in range(4)},
            SHOT_STEP: (shown.still, 4),
            SHOT_STEP + 1: (shown.still, 5),
        },
    )
    check_body(output, shown, {0: 0, 3: 3, SHOT_STEP: 4, SHOT_STEP + 1: 5}, 0.3)


def test_pose2sim(tmp_path, shown):
    folder = writers.pose2sim(tmp_path / "rig", shown)
    numbers = [n for n in range(COUNT)] + [place * SHOT_STEP + n for place in (1, 2) for n in range(FEW)]
    at = [shown.still] * COUNT + [take for take in shown.rig[1:] for _ in range(FEW)]
    rows = list(range(COUNT)) + 2 * list(range(FEW))
    masks = tmp_path / "masks"
    writers.pictures(
        masks, [t.masks[r] for t, r in zip(at, rows, strict=True)], [f"{n}.png" for n in numbers]
    )
    together = dataclasses.replace(
        shown.still, keypoints=np.stack([t.keypoints[r] for t, r in zip(at, rows, strict=True)])
    )
    output = ingest(
        tmp_path, folder, masks=str(masks), keypoints=points(tmp_path, together, numbers),
        test_cameras=("others",), test_frames=3,
    )  # fmt: skip
    split = read_split(output / "split.json")
    assert list(split.train) == list(range(COUNT)) and list(split.test) == numbers[COUNT:]
    cameras = read_cameras(output / "cameras.parquet", torch.float64)
    joints, _ = joints_and_surface(shown, shown.poses, list(range(COUNT)))
    for number, take, row in zip(numbers, at, rows, strict=True):
        found = project(cameras[number], torch.from_numpy(joints[row])).numpy()
        there = joints[row] @ take.rotation[row].T + take.translation[row]
        assert np.abs(found - ((there / there[:, 2:]) @ take.matrix.T)[:, :2]).max() < 1e-2
    with pytest.raises(UserError, match="cam7"):
        ingest(tmp_path / "other", folder, camera_name="cam7")


def test_a_folder_of_pictures_is_one(tmp_path, shown):
    writers.pictures(tmp_path / "plain", shown.still.images, [f"{n}.png" for n in range(COUNT)])
    writers.pictures(tmp_path / "masks", shown.still.masks, [f"{n}.png" for n in range(COUNT)])
    settings = {"keypoints": points(tmp_path, shown.still, range(COUNT)), "masks": str(tmp_path / "masks")}
    output = ingest(tmp_path, tmp_path / "plain", **settings)
    same_pictures(output, shown.still, range(COUNT))
    assert read_cameras(output / "cameras.parquet")[0].width == SIZE
