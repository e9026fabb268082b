"""The command line: one module per command, no numerics. It may import every other room."""
