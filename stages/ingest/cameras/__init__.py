"""The cameras of a clip: a static pinhole, the user's calibration, or structure from motion.

:mod:`.choose` is the way in. It measures whether the background moves (:mod:`.background_motion`), takes
cameras from the user's files (:mod:`.calibration_files`, :mod:`.rig`) or finds them
(:mod:`.structure_from_motion`, :mod:`.rotation_only`), and puts them into a world in metres whose Y axis
points up (:mod:`.scale`, :mod:`.extrinsics`). :mod:`.distortion` takes the distortion out of the frames.
"""
