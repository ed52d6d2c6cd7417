"""What happens when a run is killed: ``python -m tests.faults --kills 100``."""
