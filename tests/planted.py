"""Files named like modules of Python and of libraries, which note that they were run."""

import os
import subprocess
import sys
from pathlib import Path

import super_sdf

FIRST = ("abc", "copyreg", "io", "multiprocessing", "runpy", "struct", "tempfile", "threading")
LATER = ("numpy", "pickle", "psutil", "selectors", "signal", "socket", "trimesh")
COMMAND = "from super_sdf.cli.main import main\n\nif __name__ == '__main__':\n    main()\n"
NOTE = "open({marker!r}, 'a').write(__name__ + ' ')\nraise ImportError('of the current folder')\n"


def run_beside_planted_files(folder, code, *words):
    """Run a script, which lies elsewhere as a command does; return the process and which files ran.

    Without code it is ``python -m super_sdf``, for which Python itself reads some of the folder.
    """
    marker, script = folder / "ran.txt", folder / "elsewhere" / "command.py"
    for name in (*(FIRST if code else ()), *LATER):
        (folder / f"{name}.py").write_text(NOTE.format(marker=str(marker)))
    script.parent.mkdir()
    script.write_text(code)
    paths = [str(Path(file).parent.absolute()) for file in (super_sdf.__path__[0], __file__)]
    done = subprocess.run(
        [sys.executable, *([script] if code else ["-m", "super_sdf"]), *map(str, words)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )
    return done, marker.read_text().split() if marker.exists() else []
