"""Videos in HLG, PQ and with wide primaries: the colours that they stand for, by the standards' formulas."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from stages.ingest.tone_mapping import map_picture
from stages.ingest.video import open_clip, read_clip

HLG, PQ, SDR = 18, 16, 1
BT709, BT2020, P3 = 1, 9, 12
SKIN = (195, 130, 120)
PATCHES = np.array([SKIN, (128, 128, 128), (30, 40, 60), (200, 200, 190), (90, 150, 80), (225, 225, 225)])


def srgb_to_light(codes: np.ndarray) -> np.ndarray:
    share = codes / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def chromaticities(primaries: dict[str, tuple[float, float]]) -> np.ndarray:
    """RGB -> XYZ of primaries with D65's white, from their chromaticities."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (primaries[c] for c in "rgb")]).T
    white = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
    return columns * np.linalg.solve(columns, white)


SPACES = {
    BT709: chromaticities({"r": (0.64, 0.33), "g": (0.30, 0.60), "b": (0.15, 0.06)}),
    BT2020: chromaticities({"r": (0.708, 0.292), "g": (0.170, 0.797), "b": (0.131, 0.046)}),
    P3: chromaticities({"r": (0.680, 0.320), "g": (0.265, 0.690), "b": (0.150, 0.060)}),
}


def coded(codes: np.ndarray, transfer: int, primaries: int) -> np.ndarray:
    """sRGB's codes as another signal in 0..1, by the formulas of BT.2100 and with white at 203 cd/m²."""
    light = srgb_to_light(codes) @ (np.linalg.inv(SPACES[primaries]) @ SPACES[BT709]).T
    light = np.clip(light, 0, None)
    if transfer == PQ:
        power = (light * 203 / 10000) ** 0.1593017578125
        return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    if transfer == HLG:
        shown = light * 0.203
        luminance = np.maximum(shown @ [0.2627, 0.6780, 0.0593], 1e-9)[..., None]
        scene = shown * luminance ** (1 / 1.2 - 1)
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        return np.where(scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(
    ("transfer", "primaries"), [(HLG, BT2020), (PQ, BT2020), (PQ, P3), (SDR, BT2020), (SDR, P3)]
)
def test_wide_signals_become_the_colours_that_they_stand_for(transfer: int, primaries: int) -> None:
    signal = np.rint(65535 * coded(PATCHES, transfer, primaries)).astype(np.uint16)
    found = map_picture(signal[None], transfer, primaries)[0]
    assert np.abs(found.astype(int) - PATCHES).max() <= 1


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_highlights_are_bent_and_stay_in_order(transfer: int) -> None:
    ramp = np.repeat(np.arange(0, 65536, 64, dtype=np.uint16)[None, :, None], 3, 2)
    grey = map_picture(ramp, transfer, BT2020)[0].astype(int)
    assert (np.diff(grey[:, 0]) >= 0).all() and grey[0].max() == 0 and grey[-1].min() >= 254
    assert (np.ptp(grey, axis=1) <= 1).all(), "grey stays grey"


def write_patches(path: Path, transfer: int, primaries: int, matrix: int, full: bool = False) -> Path:
    """A 10-bit clip of the patches, each 32 pixels wide, with its tags."""
    signal = coded(PATCHES, transfer, primaries)
    red, blue = {1: (0.2126, 0.0722), 9: (0.2627, 0.0593), 5: (0.299, 0.114)}[matrix]
    luma = signal @ [red, 1 - red - blue, blue]
    chroma = [(signal[:, 2] - luma) / (2 - 2 * blue), (signal[:, 0] - luma) / (2 - 2 * red)]
    planes = [1023 * luma, *(512 + 1023 * one for one in chroma)] if full else [
        64 + 876 * luma, *(512 + 896 * one for one in chroma)
    ]  # fmt: skip
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", 25, options={"crf": "1", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 32 * len(PATCHES), 32, "yuv420p10le"
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.colorspace = transfer, primaries, matrix
        context.color_range = 2 if full else 1
        rows = [np.repeat(np.clip(np.rint(plane), 0, 1023).astype(np.uint16), 32) for plane in planes]
        y, u, v = np.tile(rows[0], (32, 1)), np.tile(rows[1][::2], (16, 1)), np.tile(rows[2][::2], (16, 1))
        stacked = np.concatenate([y.ravel(), u.ravel(), v.ravel()]).reshape(48, -1)
        frame = av.VideoFrame.from_ndarray(stacked, format="yuv420p10le")
        frame.color_trc, frame.color_primaries, frame.colorspace = transfer, primaries, matrix
        frame.color_range = 2 if full else 1
        for _ in range(2):
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("transfer", "primaries", "matrix", "full"),
    [(HLG, BT2020, 9, False), (PQ, BT2020, 9, False), (PQ, BT2020, 9, True), (PQ, P3, 9, False),
     (SDR, P3, 1, False), (SDR, BT2020, 9, False), (SDR, BT709, 1, False), (SDR, BT709, 1, True),
     (SDR, BT709, 5, False)],
)  # fmt: skip
def test_a_video_shows_its_colours_whatever_their_code(
    tmp_path: Path, transfer: int, primaries: int, matrix: int, full: bool
) -> None:
    clip = open_clip(write_patches(tmp_path / "clip.mkv", transfer, primaries, matrix, full))
    image = next(read_clip(clip)).image
    found = image[8:24].reshape(16, len(PATCHES), 32, 3)[:, :, 8:24].mean((0, 2))
    assert np.abs(found - PATCHES).max() <= 3
    assert bool(clip.notes) == ((transfer, primaries) != (SDR, BT709))
