"""Motions that no camera filmed: reading them, and carrying them over to a person.

``motion_name`` says what ``motion=`` may be; ``bvh``, ``amass``, ``smplx_json`` and ``fitted_motion`` read
one kind each and give a ``Motion``; ``placement`` stands it on the ground on another person's legs. ``read``
is the way in.
"""
