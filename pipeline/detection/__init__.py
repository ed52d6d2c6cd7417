"""What is detected of a person in a picture: MediaPipe's landmarks and segmentations."""
