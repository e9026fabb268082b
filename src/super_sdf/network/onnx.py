"""The only module that imports onnxruntime, so that it is always imported without telemetry.

Since 2026 the wheels for Linux and macOS send usage data by default: the import writes files under
the user's cache folder, and a process that runs for a minute sends data about its machine. A tool
for people's own shapes must not do that without their consent.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import DeviceError

SWITCH = "ORT_DISABLE_TELEMETRY"  # a variable that onnxruntime reads once, when it is imported


@contextmanager
def without_telemetry() -> Iterator[None]:
    """Switch off onnxruntime's telemetry while it is imported, unless the user set the variable.

    The variable is removed afterwards, so that child processes see the user's own environment. It
    has no effect if other code imported onnxruntime before.
    """
    if SWITCH in os.environ:
        yield
        return
    os.environ[SWITCH] = "1"
    try:
        yield
    finally:
        os.environ.pop(SWITCH, None)


def first_line(error: Exception) -> str:
    """Return the message of an onnxruntime error in one line.

    For a failure of CUDA this is the part of interest in a long line of source files and template
    arguments.
    """
    failure = re.search(r"CUDA failure \d+: [^;\n]*", str(error))
    if failure:
        return failure[0].strip()
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


try:
    with without_telemetry():
        import onnxruntime as ort
except Exception as error:  # a broken installation fails in other ways than ImportError, too
    raise DeviceError(
        f"onnxruntime cannot be imported ({first_line(error)}): pip install --force-reinstall "
        "onnxruntime"
    ) from error

__all__ = ["first_line", "ort"]
