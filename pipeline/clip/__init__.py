"""A subject's clip as every stage after the fit reads it: pictures, cameras and the fitted body."""

from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.clip.views import View, ViewCache

__all__ = ["FittedClip", "View", "ViewCache", "read_fitted_clip"]
