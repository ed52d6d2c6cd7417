"""What the clip shows of each vertex: its frames as :mod:`pipeline.texture` reads them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from pipeline import texture
from pipeline.frames import read_frame, read_mask
from pipeline.texture import FineSurface, Seen, View
from stages.auxiliary.turn import Clip

if TYPE_CHECKING:
    from pipeline.stage import Context


def gather(clip: Clip, surface: FineSurface, frames: Sequence[int], context: Context) -> Seen:
    """Colours of all vertices from some frames of the clip."""
    with context.progress(len(frames), "texture") as progress:

        def views() -> Iterator[View]:
            for frame in frames:
                image = read_frame(clip.folder / "frames", frame)
                mask = read_mask(clip.folder / "masks", frame)
                yield View(clip.cameras[frame], clip.vertices(frame), image, mask)
                progress.advance()

        return texture.gather(surface, views(), len(frames))
