"""The procedural generator of closed solids: training without mesh data."""
