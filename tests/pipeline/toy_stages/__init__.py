"""Three tiny stages, so that the DAG and the store are tested in seconds."""
