"""Grid files in, mesh files and refined fields out: libraries read the formats, complete files only."""
