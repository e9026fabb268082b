"""The only module that imports onnxruntime, so that it is always imported without telemetry.

Since 2026 the wheels for Linux and macOS send usage data by default: the import writes files under
the user's cache folder, and a process that runs for a minute sends data about its machine. A tool
for people's own shapes must not do that without their consent.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import DeviceError

# An environment variable that onnxruntime reads once, when it is imported.
SWITCH = "ORT_DISABLE_TELEMETRY"


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


try:
    with without_telemetry():
        import onnxruntime as ort
except Exception as error:  # a broken installation fails in other ways than ImportError, too
    reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
    raise DeviceError(
        f"onnxruntime cannot be imported ({reason}): pip install --force-reinstall onnxruntime"
    ) from error

__all__ = ["ort"]
