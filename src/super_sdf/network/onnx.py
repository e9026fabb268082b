"""Sessions of onnxruntime, which this module alone imports, on the CPU or on a GPU through CUDA.

Its telemetry is off: the wheels of 2026 for Linux and macOS write files under the user's cache
folder and send data about the machine. Where onnxruntime would fall back from CUDA to the CPU
silently, an error names what is missing.
"""

from __future__ import annotations

import ctypes
import io
import os
import re
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stdout
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import DeviceError, ModelError
from ..threads import count_cores


def first_line(error: Exception) -> str:
    """Return the message of an onnxruntime error in one line; of CUDA's, the part of interest."""
    failure = re.search(r"CUDA failure \d+: [^;\n]*", str(error))
    text = failure[0].strip() if failure else str(error).strip()
    return next(iter(text.splitlines()), type(error).__name__)


SWITCH = "ORT_DISABLE_TELEMETRY"  # read once, at the import
said_by_user = SWITCH in os.environ
os.environ.setdefault(SWITCH, "1")
try:
    import onnxruntime as ort
except Exception as error:  # a broken installation fails in other ways than ImportError, too
    way_out = "pip install --force-reinstall onnxruntime"
    raise DeviceError(f"onnxruntime cannot be imported ({first_line(error)}): {way_out}") from error
finally:
    if not said_by_user:  # child processes get the user's own environment
        del os.environ[SWITCH]

CUDA_VERSION = vars(ort).get("cuda_version", "")
VERSION = f"onnxruntime {ort.__version__}" + (CUDA_VERSION and f" for CUDA {CUDA_VERSION}")
CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
CUDA_OPTIONS = {
    # No device_id: 0 is the default, and onnxruntime 1.26 and later print a warning if it is given.
    # Take only the memory that a run needs; with SHRINK the next run finds it unfragmented.
    "arena_extend_strategy": "kSameAsRequested",
    "use_tf32": "0",  # its 10-bit mantissa is too short for 1e-4 of a voxel
}
OPTIMISED = "optimised_by"  # in the metadata, which end a file
# onnxruntime allocates from an arena, so that layers reuse the memory of earlier ones. The next
# grid has another size, so the arena is shrunk after runs of more voxels, or more values.
SHRINK, SMALL, SMALL_OUTPUT = "memory.enable_memory_arena_shrinkage", 20_000, 5_000_000
# An optional fifth input of networks: the rows of the neighbour table per chunk. With fewer a core
# than this, cores wait for each other; with more, what they gather leaves the cache. A GPU waits
# between chunks, so it gets large ones: with 27 * 64 gathered floats a row, 113 MB.
CHUNK_INPUT, CORE_CHUNK, CPU_CHUNK, CUDA_CHUNK = "chunk", 512, 4096, 16384


def open_session(path: Path, device: str, threads: int) -> ort.InferenceSession:
    """Open an ONNX file on the "cpu" or on "cuda".

    ModelError if onnxruntime cannot read the file, DeviceError if CUDA cannot run.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors are raised; the other messages are not for users
    options.enable_mem_pattern = False  # useful only if all inputs have the same size
    # A thread that waits for the next operator keeps its core busy for so long, 1 ms by default: on
    # a machine with other work to do that takes ten times as long.
    options.add_session_config_entry("session.intra_op.spin_duration_us", "100")
    if device == "cuda":
        check_cuda()
        on_cuda = {"providers": [(CUDA, CUDA_OPTIONS), CPU], "enable_fallback": 0}
        with failures_on(device):
            session = ort.InferenceSession(str(path), options, **on_cuda)
        if CUDA not in session.get_providers():
            raise DeviceError(f"{VERSION} could not start its CUDA provider")
        return session
    try:
        with path.open("rb") as file:
            file.seek(-min(path.stat().st_size, 8192), os.SEEK_END)
            optimised = OPTIMISED.encode() in file.read()
        if optimised:  # opens in half the time
            options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        return ort.InferenceSession(str(path), options, providers=[CPU])
    except Exception as error:  # onnxruntime's errors have no other common base class
        said = f"{path} is no ONNX file that onnxruntime can run: {first_line(error)}"
        raise ModelError(said) from error


def run(session: ort.InferenceSession, feeds: Mapping[str, Any], device: str = "cpu") -> FloatArray:
    """Run a session, given its inputs by name, and return its output, (D, Q) float32.

    An interrupt stops the run within milliseconds: onnxruntime runs in another thread, since Python
    handles no interrupt meanwhile, and looks at ``terminate`` between two operators. DeviceError if
    onnxruntime fails.
    """
    options, on_cpu, voxels = ort.RunOptions(), device == "cpu", len(feeds["patches"])
    shape = len(feeds["voxels"]), len(feeds["offsets"])
    values = np.empty(shape if on_cpu else 0, np.float32)  # in the arena it could not be shrunk
    if not on_cpu or voxels > SMALL or values.size > SMALL_OUTPUT:
        options.add_run_config_entry(SHRINK, "cpu:0" if on_cpu else "gpu:0")
    with failures_on(device), ThreadPoolExecutor(1) as pool:
        binding, output, rows = session.io_binding(), session.get_outputs()[0].name, CUDA_CHUNK
        if on_cpu:
            threads = session.get_session_options().intra_op_num_threads or count_cores()
            count = ceil((voxels + 1) / min(CORE_CHUNK * threads, CPU_CHUNK))
            rows = ceil((voxels + 1) / count)  # chunks of equal size; the graph adds a row
            for name, array in feeds.items():
                binding.bind_cpu_input(name, array)
            binding.bind_output(output, "cpu", 0, np.float32, shape, values.ctypes.data)
        else:  # each input is copied to the device once, and the output back once
            for name, array in feeds.items():
                there = ort.OrtValue.ortvalue_from_numpy(array, device, 0)
                binding.bind_ortvalue_input(name, there)
            binding.bind_output(output, device, 0)
        chunk = ort.OrtValue.ortvalue_from_numpy(np.array([rows]), "cpu", 0)
        if any(given.name == CHUNK_INPUT for given in session.get_overridable_initializers()):
            binding.bind_ortvalue_input(CHUNK_INPUT, chunk)
        try:
            pool.submit(session.run_with_iobinding, binding, options).result()
        finally:
            options.terminate = True
        return values if on_cpu else binding.copy_outputs_to_cpu()[0]


@contextmanager
def failures_on(device: str) -> Iterator[None]:
    """Turn exceptions of onnxruntime into DeviceError."""
    try:
        yield
    except Exception as error:
        raise DeviceError(f"the network failed on {device}: {first_line(error)}") from error


def available_devices() -> list[str]:
    """Return the devices that the installed onnxruntime was built for."""
    return ["cpu"] + ["cuda"] * (CUDA in ort.get_available_providers())


def check_cuda() -> None:
    """Raise DeviceError if onnxruntime has no CUDA or does not find its libraries."""
    if "cuda" not in available_devices():
        way_out = "install onnxruntime-gpu in place of onnxruntime"
        raise DeviceError(f"{VERSION} here has no CUDA provider: {way_out}")
    if not has_driver():
        raise DeviceError(f"there is no {DRIVER}: install the NVIDIA driver")
    if hasattr(ort, "preload_dlls"):  # since 1.21; finds libraries that pip installed
        with redirect_stdout(io.StringIO()):  # it prints
            ort.preload_dlls()
    library = Path(ort.__file__).parent / "capi" / "libonnxruntime_providers_cuda.so"
    try:
        if sys.platform == "linux":
            ctypes.CDLL(str(library))
    except OSError as error:
        way_out = "pip install 'onnxruntime-gpu[cuda,cudnn]' brings CUDA's libraries"
        raise DeviceError(f"{VERSION} does not load, {error}: {way_out}") from error


def has_driver() -> bool:
    """Return whether the NVIDIA driver's library can be loaded."""
    try:
        return bool(ctypes.CDLL(DRIVER))
    except OSError:
        return False
