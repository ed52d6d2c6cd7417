"""Motions that no camera filmed: reading them, and giving them to a person.

``source`` says what ``motion=`` may be; ``amass``, ``pose_folder`` and ``fitted_motion`` read one kind each,
``read`` any kind, BVH included; ``placement`` stands a motion on the ground on another person's legs.
"""
