"""How a grid is cut into slabs so that the work fits in memory. It may import the steps."""
