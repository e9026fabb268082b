"""``python -m lab COMMAND``: one line for every error, as in the command of the package."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

COMMANDS = {
    "evaluate": "measure the quality on your own meshes",
    "render": "draw meshes, or a cross-section of a grid",
    "figures": "measure what README, the documents and the model cards quote",
    "documents": "write the measured figures into them",
    "meshes": "does a change of the code change a mesh",
    "bounds": "does a conversion stay within --max-memory",
    "faults": "conversions and batches ended at random moments, also on a cluster, and full disks",
    "zoo": "grids as people have them, and the ways out that refusals name",
    "corpus": "thousands of bad and odd inputs, and random fields",
    "cuda": "CUDA against the CPU",
    "versions": "releases of Python and of the dependencies",
    "picture": "the pictures in README and of sharp edges",
}


def module_of(command: str) -> ModuleType:
    """Return the module of a command; the corpus is beside the tests that run a part of it."""
    if command == "corpus":
        sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
        return import_module("corpus.command")
    return import_module(f"lab.{command}")


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
        return module_of(command).main() or 0
    except OptionError as error:
        print(f"Error: {error}", file=sys.stderr)
        return 2
    except SuperSdfError as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Error: interrupted; what was measured is kept", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
