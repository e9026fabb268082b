"""The contract of an ONNX file with this package: its inputs, output and metadata.

Inputs are ``patches`` (V, 27), ``neighbours`` (V, 27), ``voxels`` (D,) and ``offsets`` (Q, 3); the
output is ``values`` (D, Q). Distances and offsets are in half voxels. The metadata, the model card,
holds the receptive field, the training factors, data and accuracy. Its entry ``inputs`` is what the
network was trained on: ``EXACT_DISTANCES``, hardly any of them noisy; or ``MASKS``; without the
entry, distances of which some were noisy.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError, seen

FORMAT_VERSION = 1
EXACT_DISTANCES, MASKS = "exact distances", "masks"
INPUTS = {
    "patches": "tensor(float)",
    "neighbours": "tensor(int32)",
    "voxels": "tensor(int32)",
    "offsets": "tensor(float)",
}
OUTPUT = {"values": "tensor(float)"}
# Whole numbers of a card with unit and largest value. A receptive field is to each side; a network
# that sees farther, up to the whole grid, states none. The width decides the memory of a run.
WHOLE = {"receptive_field": ("voxels", 1000), "channels": ("channels of width", 10_000)}
TRIAL: dict[str, Any] = {  # one voxel, and two offsets to notice an output with its axes swapped
    "patches": np.zeros((1, 27), np.float32),
    "neighbours": np.full((1, 27), -1, np.int32),
    "voxels": np.zeros(1, np.int32),
    "offsets": np.zeros((2, 3), np.float32),
}


def read_card(session: Any, path: Path) -> dict[str, Any]:
    """Return the metadata of a file; ModelError if it does not fulfil the contract."""
    try:
        inputs = {given.name: given.type for given in session.get_inputs()}
        outputs = {made.name: made.type for made in session.get_outputs()}
        metadata = session.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise ModelError(f"{path} is damaged: it has names that are not UTF-8 text") from error
    version, again = metadata.get("format_version"), "export it again with export/to_onnx.py"
    if (inputs, outputs, version) != (INPUTS, OUTPUT, str(FORMAT_VERSION)):
        raise ModelError(
            f"{path} is no super-sdf network of format {FORMAT_VERSION} (format {seen(version)}, "
            f"inputs {seen(inputs)}, outputs {seen(outputs)}): {again}"
        )
    card: dict[str, Any] = {}
    for key, text in metadata.items():
        try:
            card[key] = json.loads(text)
        except json.JSONDecodeError:
            card[key] = text
        except (ValueError, RecursionError) as error:  # thousands of digits; nested too deep
            said = f"its metadata {seen(key)} cannot be read, {seen(text)}"
            raise ModelError(f"{path}: {said}; {again}") from error
    for key, (unit, most) in WHOLE.items():
        value = card.get(key, 1)
        if type(value) is not int or not 1 <= value <= most:  # True is an int, too
            must = f"it must be a whole number of {unit} from 1 to {most}"
            raise ModelError(f"{path}: its {key} is {seen(value)}; {must}: {again}")
    return card
