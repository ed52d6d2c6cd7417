"""Tables and JSON on disk."""
