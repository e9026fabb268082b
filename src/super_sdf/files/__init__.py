"""Reading grid files and writing mesh files. It may import ``grid``, ``mesh`` and ``machine``."""
