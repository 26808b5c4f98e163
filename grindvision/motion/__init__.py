"""Path points in, robot programme out."""
