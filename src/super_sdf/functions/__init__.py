"""A function of points in place of samples."""
