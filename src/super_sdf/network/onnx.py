"""The one place that imports onnxruntime, so that all of this package does it alike.

Since 2026 the wheels for Linux and macOS send usage data unless they are told not to: the import
writes files under the user's cache folder, and a process that lives for a minute sends what it
runs on. A tool for people's own shapes does not do that unasked.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import DeviceError

# onnxruntime reads it once, when it is imported.
SWITCH = "ORT_DISABLE_TELEMETRY"


@contextmanager
def without_telemetry() -> Iterator[None]:
    """Switch onnxruntime's telemetry off while it is imported, unless the user has decided.

    The variable is taken back afterwards: programs that this process starts find the environment
    as the user left it. If onnxruntime was imported before, by someone else, nothing is changed.
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
except Exception as error:  # a broken installation fails in many ways, not by ImportError alone
    reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
    raise DeviceError(
        f"onnxruntime cannot be imported ({reason}): pip install --force-reinstall onnxruntime"
    ) from error

__all__ = ["ort"]
