"""Cutting a grid into slabs so that the work fits in memory. It may import the steps."""
