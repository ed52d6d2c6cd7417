"""The stage with its real estimator, on a few frames of the sample clip; skipped without the assets."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.clip.frames import read_mask
from pipeline.clip.keypoints import BODY, FACE, LEFT_HAND, read_keypoints
from pipeline.clip.records import read_footage, read_split
from pipeline.errors import UserError
from stages.ingest.run import run
from stages.ingest.video import open_clip, read_clip
from tests.made.videos import ingest_context, write_images

pytestmark = pytest.mark.assets


@pytest.fixture(scope="module")
def mediapipe(assets_folder: Path) -> Path:
    folder = assets_folder / "mediapipe"
    if not (folder / "mediapipe").is_dir():
        pytest.skip("data/assets/mediapipe is not there: doit run assets:mediapipe")
    return folder


@pytest.fixture(scope="module")
def man(assets_folder: Path) -> list[np.ndarray]:
    """Six frames of the sample clip `smile`."""
    clip = assets_folder / "smile" / "single_face.mp4"
    if not clip.is_file():
        pytest.skip("data/assets/smile is not there: doit run assets:smile")
    return [picture.image for picture in read_clip(open_clip(clip), limit=6)]


def noise(seed: int, shape: tuple[int, ...] = (360, 640, 3)) -> np.ndarray:
    return np.random.default_rng(seed).integers(118, 138, shape, dtype=np.uint8)


def ingest(folder: Path, images: list[np.ndarray], mediapipe: Path, **settings: object) -> Path:
    source = write_images(folder / "pictures", images)
    context = ingest_context(folder / "run", source, {"mediapipe": mediapipe}, **settings)
    run(context)
    return context.output


def test_a_head_is_found_and_masked(tmp_path: Path, man: list[np.ndarray], mediapipe: Path) -> None:
    output = ingest(tmp_path, man, mediapipe)
    footage = read_footage(output / "footage.json")
    assert (footage.kept, footage.people, footage.dropped) == (6, 1, {})
    assert len(read_split(output / "split.json").test) == 1
    points = read_keypoints(output / "keypoints.parquet")
    scores = points.whole_body[..., 2]
    assert (scores[:, FACE] > 0.9).all(), "the whole face is in view"
    assert (scores[:, BODY][:, 11:] == 0).all(), "hips and legs are out of view"
    assert (scores[:, LEFT_HAND] == 0).all()
    nose, chin = points.whole_body[:, 0], points.whole_body[:, FACE][:, 8]
    assert (nose[:, 1] < chin[:, 1]).all()
    for row, frame in enumerate(points.frames):
        mask = read_mask(output / "masks", int(frame))
        assert 0.15 < (mask > 127).mean() < 0.4
        assert mask[int(nose[row, 1]), int(nose[row, 0])] == 255
        assert mask[:60, :60].max() == 0 and mask[:60, -60:].max() == 0
        assert ((mask > 25) & (mask < 230)).sum() < 0.1 * (mask > 127).sum(), "the edge is narrow"


def test_equal_runs_give_equal_bytes(tmp_path: Path, man: list[np.ndarray], mediapipe: Path) -> None:
    first, second = (ingest(tmp_path / name, man[:3], mediapipe) for name in ("first", "second"))
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert len(files) == 3 * 3 + 5
    for file in files:
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_nobody_in_noise(tmp_path: Path, mediapipe: Path) -> None:
    with pytest.raises(UserError, match=r"shows no person in any of 3 frames \(no person found: 3\)"):
        ingest(tmp_path, [noise(seed) for seed in range(3)], mediapipe)


def test_frames_without_the_person_are_dropped(
    tmp_path: Path, man: list[np.ndarray], mediapipe: Path
) -> None:
    output = ingest(tmp_path, [*man[:2], noise(0), noise(1), *man[2:4]], mediapipe)
    footage = read_footage(output / "footage.json")
    assert (footage.read, footage.kept, footage.dropped) == (6, 4, {"no person found": 2})
    assert sorted(int(path.stem) for path in (output / "masks").iterdir()) == [0, 1, 4, 5]


@pytest.mark.parametrize("large_on_the_left", [True, False])
def test_of_two_people_the_larger_is_kept(
    tmp_path: Path,
    man: list[np.ndarray],
    mediapipe: Path,
    capsys: pytest.CaptureFixture[str],
    large_on_the_left: bool,
) -> None:
    pairs = []
    for image in man:
        small = noise(0)
        small[108:] = cv2.resize(image, (448, 252))[:, :1].repeat(640, 1)
        small[108:, 96:544] = cv2.resize(image, (448, 252))
        pairs.append(np.concatenate([image, small] if large_on_the_left else [small, image], axis=1))
    output = ingest(tmp_path, pairs, mediapipe, long_side=1280)
    assert read_footage(output / "footage.json").people == 2
    said = capsys.readouterr().out
    assert "2 people at once" in said and "number 1 is kept" in said and "ingest.person=" in said
    points = read_keypoints(output / "keypoints.parquet")
    mask = read_mask(output / "masks", 3)
    mine, other = (mask[:, :640], mask[:, 640:]) if large_on_the_left else (mask[:, 640:], mask[:, :640])
    assert ((points.whole_body[:, 0, 0] < 640) == large_on_the_left).all()
    assert (mine > 127).mean() > 0.15 and (other > 127).mean() < 0.01
