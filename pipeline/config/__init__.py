"""What a run is told: the command line's request, and the words that several settings share."""
