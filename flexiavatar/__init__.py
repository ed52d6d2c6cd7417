"""The command ``flexiavatar``; what it runs lies in the packages ``pipeline`` and ``stages``."""
