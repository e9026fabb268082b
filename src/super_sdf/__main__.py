"""The command line, as ``python -m super_sdf``."""

from .cli.main import main

main()
