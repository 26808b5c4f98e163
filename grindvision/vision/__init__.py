"""A cloud in, path points out. Never sees the virtual cell or the papers."""
