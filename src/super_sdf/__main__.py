"""The command line, as ``python -m super_sdf``."""

from .cli.entry import main

main()
