"""Checks that CUDA can run on this machine, with errors that name what is missing.

onnxruntime itself falls back to the CPU silently: see ``device``.
"""

from __future__ import annotations

import ctypes
import io
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

from ..errors import DeviceError
from .onnx import ort

CUDA = "CUDAExecutionProvider"
DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"


def available_devices() -> list[str]:
    """Return the devices that the installed onnxruntime was built for."""
    return ["cpu"] + ["cuda"] * (CUDA in ort.get_available_providers())


def onnxruntime_version() -> str:
    """Return the version of onnxruntime, and of the CUDA that it was built for."""
    cuda = vars(ort).get("cuda_version", "")
    return f"onnxruntime {ort.__version__}" + (f" for CUDA {cuda}" if cuda else "")


def check_cuda() -> None:
    """Raise DeviceError if onnxruntime has no CUDA or does not find its libraries."""
    if CUDA not in ort.get_available_providers():
        raise DeviceError(
            f"{onnxruntime_version()} here has no CUDA provider: install onnxruntime-gpu in place "
            "of onnxruntime"
        )
    if not has_driver():
        raise DeviceError(f"there is no {DRIVER}: install the NVIDIA driver")
    library = _missing_library()
    if library:
        raise DeviceError(
            f"{onnxruntime_version()} does not find {library}: pip install "
            "'onnxruntime-gpu[cuda,cudnn]' brings CUDA's libraries"
        )


def _missing_library() -> str | None:
    """Return the first library that onnxruntime's CUDA provider needs and that is not installed.

    This tries to load the provider, since each version needs other libraries. None if nothing is
    missing, or on systems whose loader does not name files (Windows).
    """
    if hasattr(ort, "preload_dlls"):  # since 1.21; finds libraries that pip installed
        with redirect_stdout(io.StringIO()):  # it prints
            ort.preload_dlls()
    provider = Path(ort.__file__).parent / "capi" / "libonnxruntime_providers_cuda.so"
    try:
        ctypes.CDLL(str(provider))
    except OSError as error:
        library, _, reason = str(error).partition(": ")
        return library if "cannot open shared object file" in reason else None
    return None


def has_gpu() -> bool:
    """Return whether there seems to be an NVIDIA GPU: its device file or its driver exists."""
    return Path("/dev/nvidia0").exists() or has_driver()


def has_driver() -> bool:
    """Return whether the NVIDIA driver's library can be loaded."""
    try:
        ctypes.CDLL(DRIVER)
    except OSError:
        return False
    return True


def describe_gpu() -> str | None:
    """Return the first GPU's name, driver and free memory; None if nvidia-smi cannot tell."""
    values = query_gpu("name", "driver_version", "memory.total", "memory.used")
    if values is None:
        return None
    name, driver, total, used = values
    free = (int(total) - int(used)) * 2**20 / 1e9
    return f"{name}, driver {driver}, {free:.1f} GB free"


def query_gpu(*fields: str) -> list[str] | None:
    """Return fields of the first GPU from nvidia-smi, memory in MiB; None if it fails."""
    words = ["nvidia-smi", "-i", "0", f"--query-gpu={','.join(fields)}"]
    try:
        run = subprocess.run(
            [*words, "--format=csv,noheader,nounits"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return run.stdout.strip().split(", ")
