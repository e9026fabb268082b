"""Where a network runs: the CPU or a GPU through CUDA, and in plain words why not.

onnxruntime falls back to the CPU without a word when CUDA cannot run. Nothing here does: asked for
"cuda", it is CUDA or an error that says what is missing; asked for "auto", it is CUDA, or the CPU
with a note if there is a GPU that might have been used.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .cuda import CUDA, check_cuda, first_line, has_gpu, onnxruntime_version
from .errors import DeviceError, ModelError
from .grid import FloatArray
from .onnx import ort

DEVICES = ("auto", "cpu", "cuda")
CPU = "CPUExecutionProvider"
CUDA_OPTIONS = {
    "device_id": "0",
    # What a run takes, and no more; with SHRINK the next run does not find it fragmented.
    "arena_extend_strategy": "kSameAsRequested",
    "cudnn_conv_algo_search": "HEURISTIC",  # should a network have convolutions: no trials of each
    "use_tf32": "0",  # ten bits of a number are too few for 1e-4 of a voxel
}
# Memory comes from an arena, so that the arrays of one layer serve the next: fresh memory has to be
# zeroed by the system, which takes a third of the time of the network itself. After a run the arena
# gives back what it took, for the next grid has another size; after a small one there is no need.
SHRINK = "memory.enable_memory_arena_shrinkage"
SMALL = 20_000  # voxels
# An input that networks may have besides the four: how many rows of the neighbour table at a time.
# The file's own suits a CPU's cache; a GPU waits between chunks, so that they should be large: the
# gathered rows of this one are 27 * 64 floats each, 113 MB.
CHUNK_INPUT, CUDA_CHUNK = "chunk", 16384


@dataclass(frozen=True, eq=False)
class Opened:
    """A session that runs: where, and what the user should know of that."""

    session: ort.InferenceSession
    device: str
    notes: tuple[str, ...] = ()


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
        return Opened(open_on_cpu(path, threads, trial), "cpu")
    try:
        return Opened(open_on_cuda(path, threads, trial), "cuda")
    except DeviceError as error:
        session = open_on_cpu(path, threads, trial)  # first: it may be the file that is at fault
        if device == "cuda":
            raise DeviceError(f"cuda was asked for, but {error}; or use --device cpu") from error
        note = f"a GPU seems to be here, but the network runs on the CPU: {error}"
        return Opened(session, "cpu", (note,) * has_gpu())


def open_on_cpu(path: Path, threads: int, trial: Mapping[str, Any]) -> ort.InferenceSession:
    """Open a file on the CPU, or raise ModelError."""
    try:
        session = ort.InferenceSession(str(path), session_options(threads), providers=[CPU])
    except Exception as error:  # onnxruntime's errors have no common base but this
        reason = first_line(error)
        raise ModelError(f"{path} is no ONNX file that onnxruntime can run: {reason}") from error
    with suppress(Exception):  # a file that is no network of ours is refused later, by its card
        session.run(None, dict(trial))  # what the arena takes first it never gives back: a little
    return session


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


def run_on_cpu(session: ort.InferenceSession, feeds: Mapping[str, Any]) -> FloatArray:
    """Run a session and return its one output, (voxels, offsets).

    The output is bound to an array of ours: in the arena it would keep that from giving back.
    """
    values = np.empty((len(feeds["voxels"]), len(feeds["offsets"])), np.float32)
    binding = session.io_binding()
    for name, array in feeds.items():
        binding.bind_cpu_input(name, array)
    output = session.get_outputs()[0].name
    binding.bind_output(output, "cpu", 0, np.float32, values.shape, values.ctypes.data)
    options = ort.RunOptions()
    if len(feeds["patches"]) > SMALL:
        options.add_run_config_entry(SHRINK, "cpu:0")
    session.run_with_iobinding(binding, options)
    return values


def run_bound(
    session: ort.InferenceSession,
    feeds: Mapping[str, Any],
    place: str = "cuda",
    chunk: int = CUDA_CHUNK,
) -> FloatArray:
    """Run a session with its inputs and its one output on a device.

    Each input is copied there once and the output back once; nothing else is. ``chunk`` is how many
    rows of the neighbour table go at a time, where the file leaves that open.
    """
    binding = session.io_binding()
    bound = {name: ort.OrtValue.ortvalue_from_numpy(feeds[name], place, 0) for name in feeds}
    if any(given.name == CHUNK_INPUT for given in session.get_overridable_initializers()):
        # A size: it is wanted on the CPU, which launches the work.
        bound[CHUNK_INPUT] = ort.OrtValue.ortvalue_from_numpy(np.array([chunk]), "cpu", 0)
    for name, value in bound.items():
        binding.bind_ortvalue_input(name, value)
    binding.bind_output(session.get_outputs()[0].name, place, 0)
    options = ort.RunOptions()
    if place == "cuda":
        options.add_run_config_entry(SHRINK, "gpu:0")
    session.run_with_iobinding(binding, options)
    values: FloatArray = binding.copy_outputs_to_cpu()[0]
    return values
