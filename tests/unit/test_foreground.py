"""The person's own colours in the soft edge of a mask."""

import numpy as np

from pipeline.clip.background import Background
from pipeline.clip.foreground import read_person
from pipeline.clip.frames import write_frame, write_mask
from stages.ingest.foreground import estimate_foreground, write_foreground

PERSON, WALL = np.array([30.0, 40.0, 60.0]), np.array([240.0, 220.0, 200.0])


def mixed(center: float = 32.0, softness: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """A dark disc before a light wall, seen through a soft edge: picture and mask."""
    y, x = np.mgrid[:64, :64]
    alpha = np.clip((18 - np.hypot(x - center, y - 32)) / softness + 0.5, 0, 1)
    image = alpha[..., None] * PERSON + (1 - alpha[..., None]) * WALL
    return np.round(image).astype(np.uint8), np.round(255 * alpha).astype(np.uint8)


def test_the_wall_is_taken_out_of_the_edge():
    image, mask = mixed()
    found = estimate_foreground(image, mask)
    edge = (mask > 30) & (mask < 225)
    before, after = (np.abs(picture[edge] - PERSON).mean() for picture in (image.astype(float), found))
    assert after < 0.12 * before
    np.testing.assert_array_equal(found[mask == 255], image[mask == 255])
    assert not found[mask == 0].any()


def test_a_known_background_makes_it_exact():
    image, mask = mixed()
    plate = Background(np.tile(WALL, (64, 64, 1)).astype(np.float32), np.zeros((64, 64)), np.ones((64, 64)))
    edge = (mask > 30) & (mask < 225)
    assert np.abs(estimate_foreground(image, mask, plate)[edge] - PERSON).mean() < 6


def test_masks_without_soft_edges_or_anybody_change_nothing():
    image, mask = mixed()
    hard = np.where(mask > 127, 255, 0).astype(np.uint8)
    np.testing.assert_array_equal(estimate_foreground(image, hard)[hard > 0], image[hard > 0])
    assert not estimate_foreground(image, np.zeros_like(mask)).any()


def test_what_was_written_is_read_beside_the_photograph(tmp_path):
    for folder in ("frames", "masks"):
        (tmp_path / folder).mkdir()
    image, mask = mixed()
    write_frame(tmp_path / "frames", 3, image)
    write_mask(tmp_path / "masks", 3, mask)
    plain, _ = read_person(tmp_path, 3)
    np.testing.assert_array_equal(plain, image)
    write_foreground(tmp_path, [3])
    colors, alpha = read_person(tmp_path, 3)
    np.testing.assert_array_equal(alpha, mask)
    np.testing.assert_array_equal(colors[mask == 0], image[mask == 0])
    assert np.abs(colors.astype(int) - image)[(mask > 60) & (mask < 200)].mean() > 20
