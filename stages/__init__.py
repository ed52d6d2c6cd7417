"""The stages of the job, one folder each. They meet only on disk: no stage imports another."""
