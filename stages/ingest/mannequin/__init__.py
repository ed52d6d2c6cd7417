"""Footage with known truth: the open body, clothed and painted, moving under known poses.

A :class:`MannequinSpec` says what is filmed; ``footage.make_mannequin`` films it in memory, and
``publish.run_mannequin`` writes what the ingest stage publishes, with the truth beside it.
"""

from stages.ingest.mannequin.spec import DETECTORS, FRAMINGS, LAYERS, VIEWS, MannequinSpec

__all__ = ["DETECTORS", "FRAMINGS", "LAYERS", "VIEWS", "MannequinSpec"]
