"""The network: an ONNX file that keeps a contract.

Inputs ``patches`` (V, 27), ``neighbours`` (V, 27), ``voxels`` (D,), ``offsets`` (Q, 3); output
``values`` (D, Q). All lengths are in half voxels. The file's metadata says what it was made for.
``device`` runs it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from .cuda import first_line
from .device import open_session, run_bound, run_on_cpu
from .errors import DeviceError, FileError, ModelError, OptionError
from .grid import FloatArray, IntArray
from .onnx import ort
from .symmetry import cube_symmetries, turn

FORMAT_VERSION = 1
DEFAULT_QUALITY = "base"
# A shipped file, and over how many symmetries of the cube its answers are averaged.
QUALITIES = {"fast": ("fast", 1), "base": ("base", 1), "best": ("base", 8)}
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
    threads : int
        CPU threads; 0 for one a core.
    notes : tuple of str
        What the user should know of the device.
    """

    session: ort.InferenceSession
    card: Mapping[str, Any]
    device: str
    symmetries: int = 1
    threads: int = 0
    notes: tuple[str, ...] = ()

    @property
    def receptive_field(self) -> int | None:
        """Voxels to each side that a prediction depends on, None if the file does not say."""
        field = self.card.get("receptive_field")
        return field if isinstance(field, int) else None

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
        """Run the session.

        Of fewer voxels than offsets onnxruntime would make the sums in an order that depends on how
        many threads there are, so voxels are repeated until there are as many.
        """
        count = len(voxels)
        voxels = np.resize(voxels, max(count, len(offsets)))
        feeds = dict(zip(INPUTS, (patches, table, voxels, offsets)))
        try:
            run = run_bound if self.device == "cuda" else run_on_cpu
            return run(self.session, feeds)[:count]
        except Exception as error:  # onnxruntime's errors have no common base but this
            raise DeviceError(
                f"the network failed on {self.device}: {first_line(error)}"
            ) from error


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
    opened = open_session(path, device, threads, one_voxel())
    card = _read_card(opened.session, path)
    return Network(opened.session, card, opened.device, symmetries, threads, opened.notes)


def _cpu_for_int8(device: str) -> str:
    """Return the device for whole numbers: they gain nothing on a GPU."""
    if device == "cuda":
        raise DeviceError("int8 is for the CPU: use --precision float32 with --device cuda")
    return "cpu" if device == "auto" else device


def one_voxel() -> dict[str, Any]:
    """Return the least that a network can be asked: one voxel, without neighbours, one offset."""
    return {
        "patches": np.zeros((1, 27), np.float32),
        "neighbours": np.full((1, 27), -1, np.int32),
        "voxels": np.zeros(1, np.int32),
        "offsets": np.zeros((1, 3), np.float32),
    }


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
