"""``python -m lab COMMAND``: one line for every error, as in the command of the package."""

from __future__ import annotations

import sys
from importlib import import_module

COMMANDS = {
    "evaluate": "measure the quality on your own meshes",
    "figures": "measure what README, the documents and the model cards quote",
    "documents": "write the measured figures into them",
    "faults": "end conversions and batches at random moments, and see what is left",
    "zoo": "grids as people have them, and the ways out that refusals name",
    "picture": "draw the pictures of the documents",
}


def main() -> int:
    """Run a command; return the exit code."""
    command, *words = sys.argv[1:] or ["--help"]
    if command not in COMMANDS:
        lines = [f"  {name:10} {what}" for name, what in COMMANDS.items()]
        print("\n".join(["Usage: python -m lab COMMAND [--help]", "", *lines]))
        return 0 if command in ("-h", "--help") else 2
    from super_sdf.errors import OptionError, SuperSdfError

    sys.argv = [f"python -m lab {command}", *words]
    try:
        return import_module(f"lab.{command}").main() or 0
    except OptionError as error:
        print(f"Error: {getattr(error, 'flagged', error)}", file=sys.stderr)
        return 2
    except (SuperSdfError, OSError) as error:
        print(f"Error: {getattr(error, 'flagged', error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Error: interrupted; what was measured is kept", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
