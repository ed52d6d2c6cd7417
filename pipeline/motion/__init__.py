"""Motions that no camera filmed: reading them, and carrying them over to a person.

``names`` says what ``motion=`` may be; ``bvh``, ``amass``, ``peers`` and ``fitted`` read one kind each and
give a ``Motion`` (``record``); ``place`` stands it on the ground on another person's legs. ``read`` is the
way in.
"""
