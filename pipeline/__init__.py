"""The library that the stages share: the store, the settings, the records, the body and the renderer."""
