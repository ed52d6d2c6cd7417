"""Masks that another program has written, in whatever encoding, as soft alpha.

How a folder's masks are encoded is found from some of them together: one mask alone may be empty. In this
order:

- transparency that is not the same all over is the mask; one that is (an opaque RGBA) says nothing;
- a palette in colours is a picture of labels, of which black, or else the first, is nobody;
- values that never reach half of their range are labels (0 and 1, 0 and 100), all but 0 being the person, or
  shares of a smaller range (0 to 100);
- 16 bits are 65,535 at most, unless all values are of 8 bits; floating point is 1 at most, or 255;
- white is the person, unless most of the picture's rim is white and the person's points lie on the black;
- colours, or a picture that is mostly grey, are no mask, and a mask has the footage's proportions: refused.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UserError
from pipeline.untrusted import GIGABYTE, bounded_bytes, check_picture

LOOKED_AT = 24  # masks whose encoding is looked at
_LABELS = 64  # different values at most, where they are labels
_GREY = 0.5  # share of pixels between black and white from which on a picture is no mask
_COLOURED = 24  # levels between a pixel's channels
_RIM_WHITE = 0.6  # share of the picture's rim
_LEAST = 0.002  # of the picture: a person's smallest mask
_DIFFERENT = 0.02  # share by which proportions may differ, beside a pixel and a half
_REMEDY = "replace it, or set ingest.masks=mediapipe"


@dataclasses.dataclass(frozen=True)
class MaskForm:
    """How a folder's masks are encoded.

    Attributes:
        kind: the person is ``white``, ``inverted`` (black) or ``nonzero``.
        alpha: whether transparency is the mask.
        full: the value of a pixel that is wholly the person's; with ``inverted``, of one wholly not.
        empty: the value of the others.
    """

    kind: str = "white"
    alpha: bool = False
    full: float = 255.0
    empty: float = 0.0

    def __str__(self) -> str:
        """In words, for the log."""
        what = {"white": "white", "inverted": "black", "nonzero": "all but 0"}[self.kind]
        usual = (self.empty, self.full) == (0, 255) or self.kind == "nonzero"
        scale = "" if usual else f", of {self.empty:g} to {self.full:g}"
        return f"the person is {what}{' in the alpha channel' if self.alpha else ''}{scale}"


@dataclasses.dataclass(frozen=True)
class _Channels:
    """A decoded mask: grey [H, W] and alpha [H, W] or None, float32; whether it has colours; its depth."""

    grey: np.ndarray
    alpha: np.ndarray | None
    coloured: bool
    labels: bool
    depth: str


@dataclasses.dataclass(frozen=True)
class _Look:
    """One mask at a glance: its values (some of very many), and the share of its pixels that are grey."""

    depth: str
    values: frozenset[float]
    alpha_values: frozenset[float]
    coloured: bool
    labels: bool
    between: float

    @property
    def alpha_varies(self) -> bool:
        return len(self.alpha_values) > 1


def find_form(files: Sequence[Path], kind: str = "white") -> MaskForm:
    """The encoding of some masks.

    Args:
        files: of one folder.
        kind: what the dataset says of itself; ``inverted`` and ``nonzero`` are believed.

    Raises:
        UserError: one is damaged, or they are no masks.
    """
    chosen = sampled(files)
    looks = [_look_at(file) for file in chosen]
    alpha = any(look.alpha_varies for look in looks)
    values = {value for look in looks for value in (look.alpha_values if alpha else look.values)}
    full = _full_range({look.depth for look in looks}, max(values))
    if kind == "nonzero":
        return MaskForm(kind, alpha, full)
    if not alpha and kind == "white":
        for file, look in zip(chosen, looks, strict=True):
            _refuse_pictures(file, look)
        if any(look.labels for look in looks):
            return MaskForm("nonzero")
    if len(values) == 2:
        return MaskForm(kind, alpha, max(values), min(values))
    if len(values) == 1 or max(values) >= full / 2:
        return MaskForm(kind, alpha, full)
    labels = len(values) <= _LABELS and all(value == round(value) for value in values)
    return MaskForm("nonzero", alpha) if labels else MaskForm(kind, alpha, max(values))


def sampled(files: Sequence[Path]) -> list[Path]:
    """At most ``LOOKED_AT`` of some files, evenly spread."""
    return [files[place] for place in np.unique(np.linspace(0, len(files) - 1, LOOKED_AT).astype(int))]


def _full_range(depths: set[str], largest: float) -> float:
    if "float" in depths:
        return 1.0 if largest <= 1 else 255.0
    return 65535.0 if "16" in depths and largest > 255 else 255.0


def _refuse_pictures(file: Path, look: _Look) -> None:
    if look.coloured and not look.labels:
        raise UserError(
            f"{file} is a picture in colours and no mask: give grey pictures, white where the person is, "
            "or pictures whose alpha is the person's"
        )
    if look.between > _GREY:
        raise UserError(
            f"{file} is mostly grey, {look.between:.0%} of it, and no mask: "
            "give pictures that are white where the person is and black elsewhere"
        )


def _look_at(file: Path) -> _Look:
    mask = _decode(file)
    grey, alpha = mask.grey, mask.alpha
    top = float(grey.max())
    between = float(((grey > 0.2 * top) & (grey < 0.8 * top)).mean())
    values = frozenset(np.unique(grey).tolist()[: _LABELS + 1]) | {top}
    return _Look(
        depth=mask.depth,
        values=values,
        alpha_values=frozenset() if alpha is None else frozenset(np.unique(alpha).tolist()),
        coloured=mask.coloured,
        labels=mask.labels,
        between=between if len(values) > 3 else 0.0,
    )


def _decode(path: Path) -> _Channels:
    """A mask file's channels; UserError where it is damaged or too large."""
    data = np.frombuffer(bounded_bytes(path, GIGABYTE, _REMEDY), np.uint8)
    check_picture(path, _REMEDY, data.tobytes())
    palette = _palette_labels(path)
    if palette is not None:
        grey, coloured_palette, alpha = palette
        return _Channels(grey, alpha, False, coloured_palette, "8")
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise UserError(f"{path} is not a readable picture: {_REMEDY}")
    depth = {"u1": "8", "u2": "16"}.get(image.dtype.str[1:], "float")
    image = image.astype(np.float32)
    if not np.isfinite(image).all():
        raise UserError(f"{path} holds numbers that are not finite: {_REMEDY}")
    if image.ndim == 2:
        return _Channels(image, None, False, False, depth)
    alpha = image[..., 3] if image.shape[2] == 4 else None
    colours = image[..., :3]
    grey, least = colours.max(-1), colours.min(-1)
    unequal = grey - least > _COLOURED
    flat = len(np.unique((colours[unequal] // 8), axis=0)) if unequal.any() else 0
    # A few flat colours on black are labels, drawn; many are a picture.
    labels = bool(unequal.mean() > _LEAST) and flat <= _LABELS and bool((grey == 0).mean() > _LEAST)
    drawn = (grey > 0).astype(np.float32) * 255 if labels and depth == "8" else grey
    return _Channels(drawn, alpha, bool(unequal.mean() > _LEAST), labels, depth)


def _palette_labels(path: Path) -> tuple[np.ndarray, bool, np.ndarray | None] | None:
    """A palette picture as grey [H, W], whether that is labels, and its alpha; None for any other picture."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            if picture.mode not in ("P", "PA"):
                return None
            clear = "transparency" in picture.info or picture.mode == "PA"
            alpha = np.array(picture.convert("RGBA"), np.float32)[..., 3] if clear else None
            colours = np.array(picture.convert("RGB"), np.int64)
            index = np.array(picture.convert("P") if picture.mode == "PA" else picture, np.int64)
    except (OSError, ValueError, SyntaxError):
        raise UserError(f"{path} is not a readable picture: {_REMEDY}") from None
    if (colours.max(-1) == colours.min(-1)).all():
        grey = colours[..., 0].astype(np.float32)
        # A grey palette whose colours are nearly black is an index that nobody meant to be looked at.
        return grey, False, alpha
    black = colours.max(-1) == 0
    nobody = black if black.any() else index == 0
    return np.where(nobody, 0, 255).astype(np.float32), True, alpha


def read_given_mask(path: Path, width: int, height: int, form: MaskForm | None = None) -> np.ndarray:
    """A mask file as soft alpha, resized by averaging: [height, width] uint8, 255 where it is the person.

    Args:
        path: the mask.
        width, height: of the result, pixels.
        form: its folder's encoding; None: white is the person.

    Raises:
        UserError: the file is damaged, or has other proportions.
    """
    form = form or MaskForm()
    values = _shares(_decode(path), form)
    check_proportions(path, values.shape[1], values.shape[0], width, height)
    smaller = values.shape[0] >= height
    resized = cv2.resize(
        values * 255, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    )
    return np.clip(np.round(resized), 0, 255).astype(np.uint8)


def _shares(mask: _Channels, form: MaskForm) -> np.ndarray:
    """[H, W] float32 in [0, 1], 1 where it is the person."""
    values = mask.grey
    if form.alpha:
        values = mask.alpha if mask.alpha is not None else np.full_like(mask.grey, form.full)
    if form.kind == "nonzero":
        return (values > 0).astype(np.float32)
    shares = np.clip((values - form.empty) / (form.full - form.empty), 0, 1)
    return 1 - shares if form.kind == "inverted" else shares


def check_proportions(path: Path, mask_width: int, mask_height: int, width: int, height: int) -> None:
    """UserError where a mask is not of a picture of ``width`` x ``height``, at any scale."""
    scale = max(mask_width / width, mask_height / height)
    allowed = 1.5 * max(1.0, scale) + _DIFFERENT * scale * max(width, height)
    if max(abs(mask_width - scale * width), abs(mask_height - scale * height)) <= allowed:
        return
    turned = ", or turn it" if (mask_width > mask_height) != (width > height) else ""
    raise UserError(
        f"{path} is {mask_width}x{mask_height}, the frames have the proportions of {width}x{height}: "
        f"make the masks of these frames, uncropped{turned}"
    )


def rim_is_white(path: Path, form: MaskForm) -> bool:
    """True where most of a mask's rim is white and something in it is black: it may be inverted."""
    shares = _shares(_decode(path), form)
    rim = np.concatenate([shares[0], shares[:, 0], shares[:, -1], shares[-1]])
    return bool((rim > 0.5).mean() > _RIM_WHITE and (shares < 0.5).mean() > _LEAST)


def has_own_alpha(pictures: Mapping[int, Path]) -> bool:
    """True where footage of pictures has transparency that is not the same all over."""
    from PIL import Image

    files = list(pictures.values())
    if files:
        check_picture(files[0], "replace it or take it out of the folder")
        with Image.open(files[0]) as first:
            clear = first.mode in ("RGBA", "LA", "PA") or "transparency" in first.info
        if not clear:
            return False
    alphas = (_decode(file).alpha for file in (sampled(files) if files else ()))
    return any(alpha is not None and float(alpha.max()) > float(alpha.min()) for alpha in alphas)
