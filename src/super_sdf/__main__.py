"""The command line, as ``python -m super_sdf``, which looks for modules in the current folder."""

import os
import sys


def leave_current_folder_out() -> None:
    """Remove the current folder from the path, unless this package lies in it.

    Only what Python has loaded already may be imported here.
    """
    try:
        folder = os.getcwd()
    except OSError:  # it was removed
        return
    is_there = sys.path[0] == folder and not getattr(sys.flags, "safe_path", sys.flags.isolated)
    if is_there and os.path.dirname(os.path.dirname(__file__)) != folder:
        del sys.path[0]


leave_current_folder_out()

from .cli.entry import main  # noqa: E402

main()
