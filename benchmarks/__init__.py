"""Quality and speed of super-sdf, measured beside its peers by commands that print tables."""
