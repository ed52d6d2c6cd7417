"""Footage of high dynamic range or a wide gamut as ordinary pictures: sRGB, with BT.709's primaries.

ITU-R BT.2100 turns HLG and PQ into light on a display; BT.2408 puts the white of ordinary pictures at
203 cd/m². Light up to 85% of it is kept as it is; what is brighter, up to a display's peak, is bent into the
rest by one factor for the three colours, which keeps the hue. PyAV's FFmpeg has no zimg, whose filter does
the like.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import av
import numpy as np

from pipeline.errors import UserError
from pipeline.numba_kernels import exact_kernel

WHITE = 203.0  # cd/m², BT.2408
PEAK = 1000.0  # cd/m² of HLG's display, for which BT.2100 gives a system gamma of 1.2
SYSTEM_GAMMA = 1.2
KNEE = 0.85  # of white

_PQ, _HLG = 16, 18  # AVCOL_TRC_SMPTE2084, AVCOL_TRC_ARIB_STD_B67 (ISO/IEC 23091-2)
_UNKNOWN, _BT2020_NCL = 2, 9
_UNREADABLE = {10: "BT.2020 with constant luminance", 14: "ICtCp", 15: "IPT-C2", 17: "YCgCo-R"}
_BT2020_TO_BT709 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]]
)
_P3_TO_BT709 = np.array(
    [[1.224940, -0.224940, 0.0], [-0.042057, 1.042057, 0.0], [-0.019638, -0.078636, 1.098274]]
)
_TO_BT709 = {9: ("BT.2020", _BT2020_TO_BT709), 11: ("P3", _P3_TO_BT709), 12: ("P3", _P3_TO_BT709)}
_LAST = 65535  # the largest code of 16 bits


def to_srgb(frame: av.VideoFrame) -> np.ndarray:
    """A frame of any colours as [H, W, 3] uint8 sRGB. Its size and time stay."""
    if not needs_mapping(frame):
        return np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
    wide = frame.color_primaries if frame.color_primaries in _TO_BT709 else 9
    return map_picture(_rgb48(frame), frame.color_trc, wide)


def needs_mapping(frame: av.VideoFrame) -> bool:
    """True where a frame is HLG or PQ, or has wider primaries than BT.709's."""
    return frame.color_trc in (_PQ, _HLG) or frame.color_primaries in _TO_BT709


def mapping_note(path: object, frame: av.VideoFrame) -> str:
    """The line that says what is done with the colours; empty where nothing is.

    Raises:
        UserError: they are coded in a way that FFmpeg does not undo.
    """
    if int(frame.colorspace) in _UNREADABLE and needs_mapping(frame):
        coded = _UNREADABLE[int(frame.colorspace)]
        raise UserError(f"{path} has colours in {coded}, which cannot be read: export it as SDR, BT.709")
    primaries = _TO_BT709.get(frame.color_primaries, ("BT.2020", None))[0]
    if frame.color_trc in (_PQ, _HLG):
        name = "PQ" if frame.color_trc == _PQ else "HLG"
        return (
            f"{name} with {primaries}'s primaries, tone mapped to sRGB (BT.2100, white at {WHITE:.0f} cd/m²)"
        )
    return f"SDR, {primaries}'s primaries: converted to BT.709's" if needs_mapping(frame) else ""


def map_picture(coded: np.ndarray, transfer: int, primaries: int) -> np.ndarray:
    """A coded picture as sRGB.

    Args:
        coded: [H, W, 3] uint16 RGB, full range.
        transfer: of ISO/IEC 23091-2: 16 is PQ, 18 HLG; another is taken as sRGB's own.
        primaries: 9 is BT.2020, 11 and 12 are P3.

    Returns:
        [H, W, 3] uint8.
    """
    matrix = _TO_BT709[primaries][1].astype(np.float32)
    knee = KNEE if transfer in (_PQ, _HLG) else np.inf
    tables = _table(_curve(transfer)), _gains(transfer == _HLG), _encoding()
    return _map_pixels(coded, *tables, matrix, np.float32(knee))


@exact_kernel
def _map_pixels(coded, lights, gains, codes, matrix, knee):
    """:func:`map_picture`, a pixel at a time: to light, system gamma, matrix, bend, to code."""
    height, width, _ = coded.shape
    picture = np.empty((height, width, 3), np.uint8)
    zero, half, one, last = np.float32(0), np.float32(0.5), np.float32(1), np.float32(_LAST)
    for row in range(height):
        for column in range(width):
            red, green, blue = coded[row, column]
            r, g, b = lights[red], lights[green], lights[blue]
            luminance = np.float32(0.2627) * r + np.float32(0.6780) * g + np.float32(0.0593) * b  # BT.2020's
            gain = gains[int(min(luminance, one) * last + half)]
            r2 = gain * (matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * b)
            g2 = gain * (matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * b)
            b2 = gain * (matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * b)
            brightest = max(r2, g2, b2)
            if brightest > knee:
                over = (brightest - knee) / (one - knee)
                share = (knee + (one - knee) * over / (one + over)) / brightest
                r2, g2, b2 = share * r2, share * g2, share * b2
            picture[row, column, 0] = codes[int(min(max(r2, zero), one) * last + half)]
            picture[row, column, 1] = codes[int(min(max(g2, zero), one) * last + half)]
            picture[row, column, 2] = codes[int(min(max(b2, zero), one) * last + half)]
    return picture


def hlg_light(signal: np.ndarray) -> np.ndarray:
    """HLG's inverse OETF (BT.2100, table 5): the scene's light, 1 at the peak."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def pq_light(signal: np.ndarray) -> np.ndarray:
    """PQ's EOTF (BT.2100, table 4): the display's light, 1 at the white of ordinary pictures."""
    m1, m2 = 2610 / 16384, 2523 / 4096 * 128
    c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    root = signal ** (1 / m2)
    return 10000 / WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)


def srgb_light(signal: np.ndarray) -> np.ndarray:
    """SRGB's EOTF (IEC 61966-2-1)."""
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)


def _curve(transfer: int) -> Callable[[np.ndarray], np.ndarray]:
    return {_HLG: hlg_light, _PQ: pq_light}.get(transfer, srgb_light)


@functools.cache
def _table(curve: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    return curve(np.arange(_LAST + 1) / _LAST).astype(np.float32)


@functools.cache
def _gains(has_system_gamma: bool) -> np.ndarray:
    """Luminance in 65,536 steps -> what light is multiplied by: HLG's system gamma, or 1."""
    luminance = np.maximum(np.arange(_LAST + 1) / _LAST, 1e-6)
    gains = PEAK / WHITE * luminance ** (SYSTEM_GAMMA - 1) if has_system_gamma else np.ones(_LAST + 1)
    return gains.astype(np.float32)


@functools.cache
def _encoding() -> np.ndarray:
    """Light in 65,536 steps -> sRGB's code."""
    light = np.arange(_LAST + 1) / _LAST
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * code).astype(np.uint8)


def _rgb48(frame: av.VideoFrame) -> np.ndarray:
    """[H, W, 3] uint16. Frames that name no matrix are BT.2020's, as HLG and PQ are."""
    matrix = _BT2020_NCL if int(frame.colorspace) == _UNKNOWN else None
    return np.asarray(frame.to_ndarray(format="rgb48le", src_colorspace=matrix), np.uint16)
