"""The network: an ONNX file that keeps a contract, run by onnxruntime (only here).

Inputs ``patches`` (V, 27), ``neighbours`` (V, 27), ``voxels`` (D,), ``offsets`` (Q, 3); output
``values`` (D, Q). All lengths are in half voxels. The file's metadata says what it was made for.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from .errors import DeviceError, FileError, ModelError, OptionError
from .grid import FloatArray, IntArray
from .symmetry import cube_symmetries, turn

FORMAT_VERSION = 1
DEFAULT_QUALITY = "base"
# A shipped file, and over how many symmetries of the cube its answers are averaged.
QUALITIES = {"fast": ("fast", 1), "base": ("base", 1), "best": ("base", 8)}
DEVICES = ("auto", "cpu", "cuda")
PRECISIONS = ("float32", "int8")
INPUTS = {
    "patches": "tensor(float)",
    "neighbours": "tensor(int32)",
    "voxels": "tensor(int32)",
    "offsets": "tensor(float)",
}
OUTPUT = "values"


@dataclass(frozen=True, eq=False)
class Network:
    """A loaded network; safe to call from several threads.

    Attributes
    ----------
    card : dict
        The file's metadata: receptive field, training factors, data, commit, accuracy.
    device : str
        Where it runs: "cpu" or "cuda".
    symmetries : int
        Over how many symmetries of the cube the values are averaged.
    """

    session: ort.InferenceSession
    card: Mapping[str, Any]
    device: str
    symmetries: int = 1

    def __call__(
        self, patches: FloatArray, table: IntArray, voxels: IntArray, offsets: FloatArray
    ) -> FloatArray:
        """Return the values (D, Q) of voxels (D,) at offsets (Q, 3), in half voxels.

        Raises
        ------
        DeviceError
            If onnxruntime fails, for want of memory on a GPU, say.
        """
        if self.symmetries == 1:
            return self._run(patches, table, voxels, offsets)
        mean = np.zeros((len(voxels), len(offsets)), np.float32)
        for symmetry in cube_symmetries()[: self.symmetries]:
            turned, turned_table, moved = turn(symmetry, patches, table, offsets)
            mean += self._run(turned, turned_table, voxels, moved) / self.symmetries
        return mean

    def _run(
        self, patches: FloatArray, table: IntArray, voxels: IntArray, offsets: FloatArray
    ) -> FloatArray:
        """Run the session."""
        feeds = {"patches": patches, "neighbours": table, "voxels": voxels, "offsets": offsets}
        try:
            values: FloatArray = self.session.run([OUTPUT], feeds)[0]
        except Exception as error:  # onnxruntime's errors have no common base but this
            raise DeviceError(
                f"the network failed on {self.device}: {_first_line(error)}"
            ) from error
        return values


def shipped_models() -> dict[str, Path]:
    """Return the networks that come with the package, by name."""
    folder = Path(str(resources.files("super_sdf.models")))
    return {path.stem: path for path in sorted(folder.glob("*.onnx"))}


def find_model(model: str | Path, precision: str = "float32") -> tuple[Path, int]:
    """Return the file of a quality or of a path, and how many symmetries it is averaged over.

    Raises
    ------
    FileError
        If there is no such file.
    OptionError
        If there is none of this precision.
    """
    if precision not in PRECISIONS:
        raise OptionError(f"precision is {precision!r}: give one of {', '.join(PRECISIONS)}")
    name, symmetries = QUALITIES.get(str(model), (str(model), 1))
    path = shipped_models().get(name, Path(model))
    if precision == "int8":
        path = path.with_name(f"{path.stem}-int8.onnx")  # beside that of float32
        if not path.is_file():
            raise OptionError(
                f"{model} has no int8 variant, {path}: write one with export.quantize"
            )
    if not path.is_file():
        names = ", ".join(QUALITIES)
        raise FileError(f"no model {str(model)!r}: give an ONNX file or one of: {names}")
    return path, symmetries


def load_network(
    model: str | Path = DEFAULT_QUALITY,
    *,
    device: str = "auto",
    threads: int = 0,
    precision: str = "float32",
) -> Network:
    """Load a network.

    Parameters
    ----------
    model : str or path
        "fast", "base" or "best" (base, averaged over reflections), or an ONNX file.
    device : str
        "cuda", "cpu", or "auto": CUDA where it runs, else the CPU.
    threads : int
        CPU threads; 0 for one a core.
    precision : str
        "float32", or "int8" for the variant in whole numbers, quicker on the CPU, where it runs.

    Raises
    ------
    FileError
        If there is no such file.
    OptionError
        If there is none of this precision.
    ModelError
        If it is not a network of this format.
    DeviceError
        If CUDA was asked for and cannot run.
    """
    path, symmetries = find_model(model, precision)
    if precision == "int8":
        device = _cpu_for_int8(device)
    session = _open_session(path, _providers(device), threads)
    used = "cuda" if "CUDAExecutionProvider" in session.get_providers() else "cpu"
    if device == "cuda" and used != "cuda":
        raise DeviceError(
            "cuda was asked for, but onnxruntime could not start its CUDA provider (are the CUDA "
            "and cuDNN libraries it wants installed?); use --device cpu"
        )
    return Network(session, _read_card(session, path), used, symmetries)


def _cpu_for_int8(device: str) -> str:
    """Return the device for whole numbers: they gain nothing on a GPU."""
    if device == "cuda":
        raise DeviceError("int8 is for the CPU: use --precision float32 with --device cuda")
    return "cpu" if device == "auto" else device


def available_devices() -> list[str]:
    """Return the devices that this onnxruntime was built for."""
    built = ort.get_available_providers()
    return ["cpu"] + ["cuda"] * ("CUDAExecutionProvider" in built)


def _providers(device: str) -> list[str]:
    """Return the execution providers to try, in order."""
    if device not in DEVICES:
        raise DeviceError(f"device is {device!r}: give one of {', '.join(DEVICES)}")
    with_cuda = "cuda" in available_devices()
    if device == "cuda" and not with_cuda:
        raise DeviceError(
            f"cuda was asked for, but onnxruntime {ort.__version__} here has no CUDA provider; "
            "install onnxruntime-gpu in place of onnxruntime, or use --device cpu"
        )
    wanted = ["CUDAExecutionProvider"] * (with_cuda and device != "cpu")
    return [*wanted, "CPUExecutionProvider"]


def _open_session(path: Path, providers: list[str], threads: int) -> ort.InferenceSession:
    """Open an ONNX file."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors come as exceptions; the rest is not for users
    # Arrays of another size at every call: an arena would keep the largest of each.
    options.enable_cpu_mem_arena = False
    options.enable_mem_pattern = False
    try:
        return ort.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's errors have no common base but this
        reason = _first_line(error)
        raise ModelError(f"{path} is no ONNX file that onnxruntime can run: {reason}") from error


def _first_line(error: Exception) -> str:
    """Return what an error says, in one line."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _read_card(session: ort.InferenceSession, path: Path) -> dict[str, Any]:
    """Return a file's metadata after checking that it keeps the contract."""
    inputs = {given.name: given.type for given in session.get_inputs()}
    outputs = [given.name for given in session.get_outputs()]
    metadata = session.get_modelmeta().custom_metadata_map
    version = metadata.get("format_version", "none")
    if inputs != INPUTS or outputs != [OUTPUT] or version != str(FORMAT_VERSION):
        raise ModelError(
            f"{path} is no super-sdf network of format {FORMAT_VERSION} (format {version}, inputs "
            f"{', '.join(inputs)}); export one with export/to_onnx.py"
        )
    return {key: _parse(text) for key, text in metadata.items()}


def _parse(text: str) -> Any:
    """Read a metadata value: JSON where it is JSON, else text."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
