"""An avatar in a browser: one page that works from a file, and the same page fed by a small local server."""
