"""Grid files in, mesh files and refined fields out: one module a library, complete files only."""
