"""The steps that find estimators' keypoints on a body."""
