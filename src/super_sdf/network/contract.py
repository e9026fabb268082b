"""What an ONNX file must keep to be a network of this package: inputs, output, metadata.

Inputs ``patches`` (V, 27), ``neighbours`` (V, 27), ``voxels`` (D,), ``offsets`` (Q, 3); output
``values`` (D, Q). All lengths are in half voxels. The metadata, the card, says what it was made
for.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError
from .onnx import ort

FORMAT_VERSION = 1
INPUTS = {
    "patches": "tensor(float)",
    "neighbours": "tensor(int32)",
    "voxels": "tensor(int32)",
    "offsets": "tensor(float)",
}
OUTPUT, OUTPUT_TYPE = "values", "tensor(float)"
# Voxels to each side. The patch alone reaches one; a network that sees farther than this sees the
# whole grid, and its card leaves the field out.
LARGEST_FIELD = 1000
SHOWN = 60  # characters of what a file says, in messages


def one_voxel() -> dict[str, Any]:
    """Return the inputs to try a network with: one voxel without neighbours, and two offsets.

    Two, so that an output with its axes swapped is noticed.
    """
    return {
        "patches": np.zeros((1, 27), np.float32),
        "neighbours": np.full((1, 27), -1, np.int32),
        "voxels": np.zeros(1, np.int32),
        "offsets": np.zeros((2, 3), np.float32),
    }


def read_card(session: ort.InferenceSession, path: Path) -> dict[str, Any]:
    """Return a file's metadata after checking that it keeps the contract, or raise ModelError."""
    try:
        inputs = {given.name: given.type for given in session.get_inputs()}
        outputs = {made.name: made.type for made in session.get_outputs()}
        metadata = session.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise ModelError(f"{path} holds names that are no UTF-8 text: it is damaged") from error
    version = metadata.get("format_version", "none")
    if inputs != INPUTS or outputs != {OUTPUT: OUTPUT_TYPE} or version != str(FORMAT_VERSION):
        raise ModelError(
            f"{path} is no super-sdf network of format {FORMAT_VERSION} (format {shortly(version)},"
            f" inputs {describe(inputs)}, outputs {describe(outputs)}); export one with "
            "export/to_onnx.py"
        )
    card = {key: _parse(key, text, path) for key, text in metadata.items()}
    _check_field(card.get("receptive_field", 1), path)
    return card


def shortly(text: str) -> str:
    """Return what a file says as a piece of one line."""
    line = " ".join(text.split())
    return line if len(line) <= SHOWN else f"{line[:SHOWN]}..."


def describe(values: Mapping[str, str]) -> str:
    """Name inputs or outputs with their types."""
    return shortly(", ".join(f"{name} {kind}" for name, kind in values.items()))


def _parse(key: str, text: str, path: Path) -> Any:
    """Read a metadata value: JSON where it is JSON, else text."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
    except (ValueError, RecursionError) as error:  # thousands of digits; nested too deep
        raise ModelError(
            f"{path}: its metadata {shortly(key)!r} is no value that can be read, "
            f"{shortly(text)!r}; export it again with export/to_onnx.py"
        ) from error


def _check_field(field: Any, path: Path) -> None:
    """Raise ModelError unless a receptive field is a number of voxels."""
    if type(field) is not int or not 1 <= field <= LARGEST_FIELD:  # True is an int, too
        raise ModelError(
            f"{path}: its receptive field is {shortly(repr(field))}; it must be a whole number of "
            f"voxels from 1 to {LARGEST_FIELD}: export it again with export/to_onnx.py"
        )
