"""Grid files in, mesh files and refined fields out: complete files only."""
