"""Everything that stages hand on about a clip: frames, cameras, keypoints, masks, the plan."""
