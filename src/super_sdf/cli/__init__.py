"""The command line: a module a command, no numerics. It may import every other room."""
