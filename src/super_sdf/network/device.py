"""Where a network runs: the CPU or a GPU through CUDA, and in plain words why not.

onnxruntime falls back to the CPU without a word when CUDA cannot run. Nothing here does: asked for
"cuda", it is CUDA or an error that says what is missing; asked for "auto", it is CUDA, or the CPU
with a note if there is a GPU that might have been used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import DeviceError, ModelError
from .cuda import CUDA, check_cuda, first_line, has_gpu, onnxruntime_version
from .names import DEVICES
from .onnx import ort
from .running import run_bound, run_on_cpu

CPU = "CPUExecutionProvider"
CUDA_OPTIONS = {
    "device_id": "0",
    # What a run takes, and no more; with SHRINK the next run does not find it fragmented.
    "arena_extend_strategy": "kSameAsRequested",
    "cudnn_conv_algo_search": "HEURISTIC",  # should a network have convolutions: no trials of each
    "use_tf32": "0",  # ten bits of a number are too few for 1e-4 of a voxel
}


@dataclass(frozen=True, eq=False)
class Opened:
    """An open session: where, what the user should know of that, and why it did not run there.

    ``failure`` is empty if it ran; else it may be a network of another kind.
    """

    session: ort.InferenceSession
    device: str
    notes: tuple[str, ...] = ()
    failure: str = ""


def open_session(path: Path, device: str, threads: int, trial: Mapping[str, Any]) -> Opened:
    """Open an ONNX file on a device.

    Parameters
    ----------
    path : path
        The file.
    device : str
        "cuda", "cpu", or "auto": CUDA where it runs, else the CPU.
    threads : int
        CPU threads; 0 for one a core.
    trial : dict
        Inputs to run once: sessions open that cannot run, on a GPU too old or full.

    Raises
    ------
    ModelError
        If onnxruntime cannot read the file.
    DeviceError
        If CUDA was asked for and cannot run.
    """
    if device not in DEVICES:
        raise DeviceError(f"device is {device!r}: give one of {', '.join(DEVICES)}")
    if device == "cpu":
        return open_on_cpu(path, threads, trial)
    try:
        return Opened(open_on_cuda(path, threads, trial), "cuda")
    except DeviceError as error:
        opened = open_on_cpu(path, threads, trial)  # first: it may be the file that is at fault
        if device == "cuda":
            raise DeviceError(f"cuda was asked for, but {error}; or use --device cpu") from error
        note = f"a GPU seems to be here, but the network runs on the CPU: {error}"
        return replace(opened, notes=(note,) * has_gpu())


def open_on_cpu(path: Path, threads: int, trial: Mapping[str, Any]) -> Opened:
    """Open a file on the CPU and run it once, or raise ModelError if it cannot be opened."""
    try:
        session = ort.InferenceSession(str(path), session_options(threads), providers=[CPU])
    except Exception as error:  # onnxruntime's errors have no common base but this
        reason = first_line(error)
        raise ModelError(f"{path} is no ONNX file that onnxruntime can run: {reason}") from error
    try:
        run_on_cpu(session, trial)  # what the arena takes first it never gives back: a little
    except DeviceError as error:  # a file that is no network of ours, as its card will tell
        return Opened(session, "cpu", failure=str(error))
    return Opened(session, "cpu")


def open_on_cuda(path: Path, threads: int, trial: Mapping[str, Any]) -> ort.InferenceSession:
    """Open a file on CUDA and run it once, or raise DeviceError, which says what is missing."""
    check_cuda()
    providers = [(CUDA, CUDA_OPTIONS), CPU]
    try:
        session = ort.InferenceSession(
            str(path), session_options(threads), providers=providers, enable_fallback=0
        )
        if CUDA in session.get_providers():
            run_bound(session, trial)
            return session
    except Exception as error:  # onnxruntime's errors have no common base but this
        raise DeviceError(f"CUDA does not run here: {first_line(error)}") from error
    raise DeviceError(f"{onnxruntime_version()} could not start its CUDA provider")


def session_options(threads: int) -> ort.SessionOptions:
    """Return what sessions on every device are told."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors come as exceptions; the rest is not for users
    options.enable_mem_pattern = False  # it is for inputs of one size
    return options
