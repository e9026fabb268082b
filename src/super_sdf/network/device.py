"""Opening a network on a device: the CPU, or a GPU through CUDA.

onnxruntime falls back to the CPU silently when CUDA cannot run. Here nothing is silent: device
"cuda" means CUDA or an error that names what is missing; "auto" means CUDA, or the CPU, with a note
if there is a GPU that could have been used.
"""

from __future__ import annotations

import ctypes
import io
import subprocess
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import DeviceError, ModelError
from ..options import DEVICES, Device
from .onnx import first_line, ort, run

CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
OPTIMISED = b"optimised_by"  # in a file's metadata, at its end; others are optimised when opened
METADATA_BYTES = 8192
CUDA_OPTIONS = {
    # No device_id: 0 is the default, and onnxruntime 1.26 and later print a warning if it is given.
    # Take only the memory that a run needs: the next run finds it unfragmented.
    "arena_extend_strategy": "kSameAsRequested",
    "cudnn_conv_algo_search": "HEURISTIC",  # no timed trials, for networks with convolutions
    "use_tf32": "0",  # its 10-bit mantissa is too short for 1e-4 of a voxel
}


@dataclass(frozen=True, eq=False)
class OpenedSession:
    """An open session, where it runs, and what the user should know about the choice."""

    session: ort.InferenceSession
    device: Device
    notes: tuple[str, ...] = ()
    failure: str = ""  # of the trial run: the file may be a network with another contract


def open_session(
    paths: tuple[Path, Path], device: str, threads: int, trial: Mapping[str, Any]
) -> OpenedSession:
    """Open an ONNX file on a device: "cuda", "cpu", or "auto", which is CUDA if it runs.

    ``paths`` are the file for the CPU and that for CUDA; ``trial`` are inputs of a trial run, since
    a session can open although it cannot run, for example on a GPU that is too old or whose memory
    is full. ModelError if onnxruntime cannot read the file, DeviceError if CUDA was asked for and
    cannot run.
    """
    if device not in DEVICES:
        raise DeviceError(f"device is {device!r}: give one of {', '.join(DEVICES)}")
    if device == "cpu":
        return _open_on_cpu(paths[0], threads, trial)
    try:
        return OpenedSession(_open_on_cuda(paths[1], threads, trial), "cuda")
    except DeviceError as error:
        opened = _open_on_cpu(paths[0], threads, trial)  # first, since the file may be the cause
        if device == "cuda":
            raise DeviceError(f"cuda was asked for, but {error}; or use --device cpu") from error
        note = f"a GPU seems to be here, but the network runs on the CPU: {error}"
        return replace(opened, notes=(note,) * has_gpu())


def _open_on_cpu(path: Path, threads: int, trial: Mapping[str, Any]) -> OpenedSession:
    """Open a file on the CPU and run it once; ModelError if it cannot be opened."""
    try:
        options = _session_options(threads)
        with path.open("rb") as file:
            file.seek(-min(path.stat().st_size, METADATA_BYTES), io.SEEK_END)
            if OPTIMISED in file.read():  # to try it again would take as long as the rest
                options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        session = ort.InferenceSession(str(path), options, providers=[CPU])
    except Exception as error:  # onnxruntime's errors have no other common base class
        reason = first_line(error)
        raise ModelError(f"{path} is no ONNX file that onnxruntime can run: {reason}") from error
    try:
        run(session, trial)  # small: the arena never gives back its first allocation
    except DeviceError as error:  # the check of its card may explain why
        return OpenedSession(session, "cpu", failure=str(error))
    return OpenedSession(session, "cpu")


def _open_on_cuda(path: Path, threads: int, trial: Mapping[str, Any]) -> ort.InferenceSession:
    """Open a file on CUDA and run it once; DeviceError, with what is missing, if it cannot run."""
    check_cuda()
    options, providers = _session_options(threads), [(CUDA, CUDA_OPTIONS), CPU]
    try:
        session = ort.InferenceSession(str(path), options, providers=providers, enable_fallback=0)
        if CUDA in session.get_providers():
            run(session, trial, "cuda")
            return session
    except Exception as error:  # onnxruntime's errors have no other common base class
        raise DeviceError(f"CUDA does not run here: {first_line(error)}") from error
    raise DeviceError(f"{onnxruntime_version()} could not start its CUDA provider")


def _session_options(threads: int) -> ort.SessionOptions:
    """Return the options of sessions, the same on every device."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors are raised; the other messages are not for users
    options.enable_mem_pattern = False  # useful only if all inputs have the same size
    # A thread that waits for the next operator keeps its core busy for so long, 1 ms by default: on
    # a machine with other work to do that takes ten times as long.
    options.add_session_config_entry("session.intra_op.spin_duration_us", "100")
    return options


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
    if hasattr(ort, "preload_dlls"):  # since 1.21; finds libraries that pip installed
        with redirect_stdout(io.StringIO()):  # it prints
            ort.preload_dlls()
    try:
        ctypes.CDLL(str(Path(ort.__file__).parent / "capi" / "libonnxruntime_providers_cuda.so"))
    except OSError as error:
        library, _, reason = str(error).partition(": ")
        if "cannot open shared object file" in reason:  # Windows does not name the file
            raise DeviceError(
                f"{onnxruntime_version()} does not find {library}: pip install "
                "'onnxruntime-gpu[cuda,cudnn]' brings CUDA's libraries"
            ) from None


def has_gpu() -> bool:
    """Return whether there seems to be an NVIDIA GPU: its device file or its driver exists."""
    return Path("/dev/nvidia0").exists() or has_driver()


def has_driver() -> bool:
    """Return whether the NVIDIA driver's library can be loaded."""
    with suppress(OSError):
        ctypes.CDLL(DRIVER)
        return True
    return False


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
    words.append("--format=csv,noheader,nounits")
    with suppress(OSError, subprocess.CalledProcessError):
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        return done.stdout.strip().split(", ")
    return None
