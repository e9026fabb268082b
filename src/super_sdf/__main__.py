"""``python -m super_sdf``."""

from .entry import main

main()
