"""Datasets as their authors' own programs write them: axes, places of files, and what is said of what lacks.

The facts are those of the authors' public code, named in each reader's docstring; the writers follow them and
not the readers. Where a convention is wrong, the body leaves the picture.
"""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.errors import UserError
from stages.ingest.datasets import layout_of, open_recording
from stages.ingest.datasets.recording import Recording
from stages.ingest.settings import IngestSettings
from tests.made import layouts as writers
from tests.made.layout_footage import COUNT, SIZE, footage


@pytest.fixture(scope="module")
def shown():
    return footage()


def read(folder: Path, **settings) -> Recording:
    return open_recording(folder, IngestSettings(**settings))


def said(recording: Recording) -> str:
    return " ".join(recording.notes)


@pytest.mark.parametrize("axes", ["opencv", "opengl"])
@pytest.mark.parametrize("texts", [False, True])
def test_insta_in_either_axes_with_either_expressions(tmp_path, shown, axes, texts):
    recording = read(writers.insta(tmp_path / "bala", shown, axes, texts))
    (shot,) = recording.shots
    for row in range(COUNT):
        view = shot.calibration.views[str(row + 1)]
        turn, shift = writers.head_camera(shown, row)
        np.testing.assert_allclose(view.rotation, turn, atol=1e-6)
        np.testing.assert_allclose(view.translation, shift, atol=1e-6)
        start = Rotation.from_rotvec(shot.poses.rotation[row, 0].numpy()).as_matrix()
        np.testing.assert_allclose(start, turn, atol=1e-5)
    assert shot.poses.frames == tuple(range(1, COUNT + 1))
    truth = shown.poses.rotation[:, 22:25].double().numpy()
    np.testing.assert_allclose(shot.poses.rotation[:, 22:25].numpy(), truth, atol=1e-4)
    np.testing.assert_allclose(shot.poses.expression[:, 3].numpy(), 0.01 * np.arange(1, COUNT + 1), atol=1e-6)
    assert recording.test == frozenset({5, 6})
    assert {"opencv": "OpenCV", "opengl": "OpenGL"}[axes] in said(recording)


def test_insta_whose_head_is_on_both_sides_is_refused(tmp_path, shown):
    folder = writers.insta(tmp_path / "bala", shown)
    table = json.loads((folder / "transforms.json").read_text())
    for frame in table["frames"][:3]:
        matrix = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frame["transform_matrix"] = matrix.tolist()
    (folder / "transforms.json").write_text(json.dumps(table))
    with pytest.raises(UserError, match=r"transforms\.json"):
        read(folder)


def test_insta_says_what_it_lacks(tmp_path, shown):
    folder = writers.insta(tmp_path / "bala", shown)
    assert "no masks" not in said(read(folder)) and "no expressions" not in said(read(folder))
    shutil.rmtree(folder / "checkpoint")
    writers.pictures(folder / "images", shown.still.images, [f"{n:05d}.png" for n in range(1, COUNT + 1)])
    recording = read(folder)
    assert "no masks" in said(recording) and "no expressions" in said(recording)
    assert recording.shots[0].poses is None
    writers.pictures(folder / "alpha", shown.still.masks, [f"{n:05d}.png" for n in range(1, COUNT + 1)])
    assert len(read(folder).shots[0].masks) == COUNT


def test_the_alpha_of_the_pictures_is_fates_mask(tmp_path, shown):
    # FATE's loader takes it from images/, without clothes; alpha/ has the clothes in it.
    folder = writers.insta(tmp_path / "bala", shown)
    whole = [np.full_like(mask, 255) for mask in shown.still.masks]
    writers.pictures(folder / "alpha", whole, [f"{n:05d}.png" for n in range(1, COUNT + 1)])
    assert read(folder).shots[0].masks is None  # the stage then reads the pictures' own


def test_gaussian_avatars_is_not_insta(tmp_path, shown):
    folder = writers.insta(tmp_path / "union", shown)
    shutil.rmtree(folder / "checkpoint")
    (folder / "flame_param").mkdir()
    np.savez(folder / "flame_param" / "00000.npz", expr=np.zeros((1, 100)))
    assert layout_of(folder) != "insta"
    with pytest.raises(UserError, match="GaussianAvatars"):
        read(folder, layout="insta")
    with pytest.raises(UserError, match="images"):  # names the folder to give
        read(folder)


def test_gaussian_avatars_is_told_by_its_index_too(tmp_path, shown):
    folder = writers.insta(tmp_path / "union", shown)
    table = json.loads((folder / "transforms.json").read_text())
    for place, frame in enumerate(table["frames"]):
        frame.update(flame_param_path=f"flame_param/{place:05d}.npz", camera_index=0, timestep_index=place)
    (folder / "transforms.json").write_text(json.dumps(table))
    with pytest.raises(UserError, match="GaussianAvatars"):
        read(folder)


@pytest.mark.parametrize("listed", [False, True])
def test_show_in_pytorch3ds_camera(tmp_path, shown, listed):
    (shot,) = read(writers.talkshow(tmp_path / "clip", shown, listed=listed)).shots
    for row in range(COUNT):
        turn, pelvis = writers.in_camera(shown, shown.still, row)
        place = shot.poses.transl[row].double().numpy() + shown.root
        np.testing.assert_allclose(place, pelvis, atol=1e-5)
        pixel = shown.still.matrix @ place
        assert (0 < pixel[:2] / pixel[2]).all() and (pixel[:2] / pixel[2] < SIZE).all()


@pytest.mark.parametrize("length", [COUNT - 1, COUNT + 1])
def test_show_of_another_length_is_refused(tmp_path, shown, length):
    folder = writers.talkshow(tmp_path / "clip", shown)
    (path,) = folder.glob("*.pkl")
    table = pickle.loads(path.read_bytes())
    rows = torch.arange(length).clamp(max=COUNT - 1)
    table = {
        key: value[rows] if torch.is_tensor(value) and len(value) == COUNT else value
        for key, value in table.items()
    }
    path.write_bytes(pickle.dumps(table))
    with pytest.raises(UserError, match=rf"{path.name}.*\b{length}\b"):
        read(folder)


def test_show_of_two_results_is_refused(tmp_path, shown):
    folder = writers.talkshow(tmp_path / "clip", shown)
    (path,) = folder.glob("*.pkl")
    path.write_bytes(pickle.dumps([pickle.loads(path.read_bytes())] * 2))
    with pytest.raises(UserError, match=path.name):
        read(folder)


@pytest.mark.parametrize("refined", [True, False])
def test_zju_in_both_releases(tmp_path, shown, refined):
    folder = writers.zju(tmp_path / "my_377", shown, np.zeros(5), refined)
    last = 5 * (COUNT - 1)
    for path in list(folder.glob("images/00/*.jpg" if refined else "Camera_B1/*.jpg")):
        for extra in range(1, 5 if int(path.stem) < last else 1):  # as a video every frame is there
            shutil.copy(path, path.with_stem(f"{int(path.stem) + extra:06d}"))
    if not refined:  # this release has mask/ besides, which its readers leave
        writers.pictures(folder / "mask" / "Camera_B1", [np.zeros((SIZE, SIZE), np.uint8)], [f"{0:06d}.png"])
    recording = read(folder, camera_name="0")
    (shot,) = recording.shots
    assert set(shot.masks) == {5 * row for row in range(COUNT)} and shot.mask_kind == "nonzero"
    parent = "mask" if refined else "mask_cihp"
    assert all(path.is_relative_to(folder / parent) for path in shot.masks.values())
    assert shot.poses.frames == tuple(5 * row for row in range(COUNT))
    assert f"{COUNT} of {last + 1} frames" in said(recording)


def test_zju_says_that_masks_and_poses_lack(tmp_path, shown):
    folder = writers.zju(tmp_path / "my_377", shown, np.zeros(5))
    shutil.rmtree(folder / "mask")
    shutil.rmtree(folder / "smpl_params")
    recording = read(folder, camera_name="0")
    assert recording.shots[0].masks is None and recording.shots[0].poses is None
    assert "no masks" in said(recording) and "no poses" in said(recording)


def test_zju_poses_have_the_number_in_the_pictures_names(tmp_path, shown):
    folder = writers.zju(tmp_path / "CoreView_313", shown, np.zeros(5), refined=False)
    annots = np.load(folder / "annots.npy", allow_pickle=True).item()
    annots["ims"] = annots["ims"][::5]
    for row, frame in enumerate(annots["ims"]):  # subjects 313 and 315: counted from 1
        name = f"Camera_B1/CoreView_313_Camera_(1)_{row + 1:04d}_2019-08-23_16-08-50.592.jpg"
        shutil.move(folder / "Camera_B1" / f"{5 * row:06d}.jpg", folder / name)
        shutil.move(folder / "new_params" / f"{5 * row}.npy", folder / "new_params" / f"n{row + 1}.npy")
        frame["ims"][0] = name
    for path in (folder / "new_params").glob("n*.npy"):
        path.rename(path.with_name(path.name[1:]))
    np.save(folder / "annots.npy", annots, allow_pickle=True)
    (shot,) = read(folder, camera_name="0").shots
    assert shot.poses.frames == tuple(range(COUNT))
    for row in range(COUNT):
        pelvis = writers.in_camera(shown, shown.rig[0], row)[1] if row < len(shown.rig[0].images) else None
        if pelvis is not None:
            place = shot.poses.transl[row].double().numpy() + shot.poses.pivot.double().numpy()
            np.testing.assert_allclose(place, pelvis, atol=1e-4)


@pytest.mark.parametrize("first", [1, 11])
def test_xhumans_mean_shape_and_meshes_counted_from_elsewhere(tmp_path, shown, first):
    person = tmp_path / "00028"
    folder = writers.xhumans(person / "train" / "Take15", shown, first)
    alone = read(folder)
    assert "mean_shape_smplx.npy" in said(alone)
    np.save(person / "mean_shape_smplx.npy", np.arange(10.0))
    recording = read(folder)
    assert "mean_shape_smplx.npy" not in said(recording)
    poses = recording.shots[0].poses
    np.testing.assert_array_equal(poses.betas.numpy(), np.arange(10.0))
    assert poses.frames == tuple(range(1, COUNT + 1))
    for row in range(COUNT):
        turn, pelvis = writers.in_camera(shown, shown.moving, row)
        found = Rotation.from_rotvec(poses.rotation[row, 0].numpy()).as_matrix()
        np.testing.assert_allclose(found, turn, atol=1e-5)
        place = poses.transl[row].double().numpy() + writers.SMPLX_ROOT
        np.testing.assert_allclose(place, pelvis, atol=1e-4)


def test_xhumans_without_some_pickles_goes_by_numbers(tmp_path, shown):
    folder = writers.xhumans(tmp_path / "Take15", shown)
    (folder / "SMPLX" / "mesh-f00002_smplx.pkl").unlink()
    recording = read(folder)
    assert recording.shots[0].poses.frames == (1, *range(3, COUNT + 1))
    assert f"{COUNT - 1} of {COUNT}" in said(recording)


PROMISES = {
    "neuman": (lambda folder, shown: writers.neuman(folder, shown, 0.4, True), ("segmentations",), "masks"),
    "wildavatar": (writers.wildavatar, ("masks",), "masks"),
    "prepared": (
        lambda folder, shown: writers.prepared(folder, shown, {}), ("keypoints_whole_body",), "keypoints"
    ),
    "persona": (writers.persona, ("captured/masks",), "masks"),
    "xhumans": (writers.xhumans, ("SMPLX",), "poses"),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(PROMISES))
def test_what_a_layout_promises_and_lacks_is_said(tmp_path, shown, name):
    write, taken, what = PROMISES[name]
    folder = write(tmp_path / "folder", shown)
    assert f"no {what}" not in said(read(folder, layout=name))
    for part in taken:
        shutil.rmtree(folder / part)
    assert f"no {what}" in said(read(folder, layout=name))
