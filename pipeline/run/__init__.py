"""Running stages: declaration, job, process, reporter, cluster."""
