"""The cameras of a clip: a static pinhole, the user's calibration, or structure from motion.

:mod:`.choose` is the way in. It measures whether the background moves (:mod:`.motion`), takes cameras from
the user's files (:mod:`.calibration`, :mod:`.colmap`, :mod:`.rig`, :mod:`.numbering`, :mod:`.lens`) or
finds them (:mod:`.structure`, :mod:`.turning`, :mod:`.gaps`), and puts them into a world in metres whose Y
axis points up (:mod:`.scale`, :mod:`.world`).
"""
