"""The steps that turn MakeHuman's CC0 data into a body of the SMPL-X schema."""
