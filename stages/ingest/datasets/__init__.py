"""What datasets look like on disk: one module a layout.

An adapter has two functions: ``recognises(folder)`` says whether a folder has its layout, and
``read(source, settings)`` makes a :class:`Recording` of it: footage, masks, cameras, keypoints, poses and
split, as far as the layout has them. What it lacks the ingest stage estimates. To add a layout, write such a
module and name it in ``registry.LAYOUTS``.
"""

from stages.ingest.datasets.recording import Recording, Shot
from stages.ingest.datasets.registry import LAYOUTS, open_recording

__all__ = ["LAYOUTS", "Recording", "Shot", "open_recording"]
