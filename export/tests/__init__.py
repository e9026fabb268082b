"""Tests of the training side; they need the export extra."""
