"""Views the camera never saw, of clips that show next to nothing."""

import json

import numpy as np
import pytest
import scipy.sparse as sparse

from pipeline.clip.frames import read_frame, read_mask, write_frame, write_mask
from pipeline.clip.records import Split, read_cameras, write_split
from pipeline.errors import UserError
from pipeline.texture import robust_mean, weighted_median
from pipeline.texture.completion import shading
from pipeline.texture.membrane import neighbours, screened_membrane
from stages.auxiliary import run as stage
from tests.made.mannequin_clip import FRAMES, context_for, write_clip

SIZE = 48


def clip_of(folder, framing="full"):
    return write_clip(folder, framing, SIZE)


def ran(place, output, **changes):
    context = context_for(place, output, generator="texture", frames=4, width=72, height=128, **changes)
    stage.run(context)
    return context


def assert_published(context):
    """Pictures that are there are pictures, their cameras finite."""
    record = json.loads((context.output / "auxiliary.json").read_text())
    assert record
    path = context.output / "cameras.parquet"
    for frame, camera in read_cameras(path).items() if path.exists() else ():
        assert camera.intrinsics.isfinite().all()
        assert read_frame(context.output / "frames", frame).dtype == np.uint8


@pytest.mark.parametrize("value", [0, pytest.param(255, marks=pytest.mark.soak)], ids=["black", "white"])
def test_flat_frames_are_painted_flat(tmp_path, value):
    place = clip_of(tmp_path / "clip")
    for frame in range(FRAMES):
        write_frame(place / "ingest" / "frames", frame, np.full((SIZE, SIZE, 3), value, np.uint8))
    context = ran(place, tmp_path / "out")
    assert_published(context)
    for path in sorted((context.output / "frames").glob("*.png")):
        number = int(path.stem)
        seen = read_mask(context.output / "masks", number) > 250
        assert (
            np.abs(read_frame(context.output / "frames", number)[seen].astype(int) - value).max(initial=0)
            <= 60
        )


def test_empty_masks_everywhere_publish_nothing_or_say_so(tmp_path):
    place = clip_of(tmp_path / "clip")
    for frame in range(FRAMES):
        write_mask(place / "ingest" / "masks", frame, np.zeros((SIZE, SIZE), np.uint8))
    try:
        assert_published(ran(place, tmp_path / "out"))
    except UserError as error:
        assert "mask" in str(error) or "nobody" in str(error)


def test_one_training_frame(tmp_path):
    place = clip_of(tmp_path / "clip")
    write_split(place / "ingest" / "split.json", Split((0,), ()))
    assert_published(ran(place, tmp_path / "out"))


# The texture's parts


def test_a_membrane_of_which_nothing_is_held_is_zero():
    chain = neighbours(np.array([[0, 1], [1, 2]]), 4)  # and a vertex without neighbours
    found = screened_membrane(chain, np.full((4, 3), 7.0), np.zeros(4), np.full(4, 1e-6))
    np.testing.assert_array_equal(found, np.zeros((4, 3)))


def test_a_membrane_that_is_held_everywhere_changes_next_to_nothing():
    values = np.arange(6.0).reshape(3, 2)
    found = screened_membrane(sparse.csr_matrix((3, 3)), values, np.full(3, 1e3), np.full(3, 1e-6))
    np.testing.assert_allclose(found, values, rtol=1e-6)


@pytest.mark.parametrize("weight", [0.0, 1e-30, 1.0, 1e30])
def test_means_of_any_weights_are_colours(weight):
    colors = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    weights = np.full((5, 7), weight, np.float32)
    for found in (weighted_median(colors[..., 0], weights), robust_mean(colors, weights)):
        assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 255


@pytest.mark.parametrize("case", ["black", "no normals", "no weight", "one normal"])
def test_light_of_what_has_none_is_finite(case):
    count = 60
    rng = np.random.default_rng(0)
    color = (rng.uniform(0, 255, (count, 3)) * (case != "black")).astype(np.float32)
    normal = rng.normal(size=(count, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.zeros_like(normal) if case == "no normals" else normal
    normal = np.tile(normal[:1], (count, 1)) if case == "one normal" else normal
    weight = np.zeros(count, np.float32) if case == "no weight" else np.ones(count, np.float32)
    found = shading(color, weight, normal, np.zeros(count, np.int64))
    assert np.isfinite(found).all() and np.isfinite(np.exp(found)).all()
