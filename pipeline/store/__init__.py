"""The versioned store of what stages publish."""
