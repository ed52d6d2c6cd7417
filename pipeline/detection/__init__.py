"""MediaPipe's landmarks and segmentations of a person, and the 133 whole-body points made of them."""
