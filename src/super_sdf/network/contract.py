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

from ..errors import ModelError
from .onnx import ort

FORMAT_VERSION = 1
EXACT_DISTANCES, MASKS = "exact distances", "masks"
INPUTS = {
    "patches": "tensor(float)",
    "neighbours": "tensor(int32)",
    "voxels": "tensor(int32)",
    "offsets": "tensor(float)",
}
OUTPUT = {"values": "tensor(float)"}
# The whole numbers of a card: name, unit and largest value. A receptive field is to each side; the
# card of a network that sees the whole grid leaves it out. The width decides how much memory a run
# takes.
WHOLE = {
    "receptive_field": ("receptive field", "voxels", 1000),
    "channels": ("width", "channels", 10_000),
}
MAX_SHOWN = 60  # characters of metadata in messages


def read_card(session: ort.InferenceSession, path: Path) -> dict[str, Any]:
    """Return the metadata of a file; ModelError if it does not fulfil the contract."""
    try:
        inputs = {given.name: given.type for given in session.get_inputs()}
        outputs = {made.name: made.type for made in session.get_outputs()}
        metadata = session.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise ModelError(f"{path} is damaged: it has names that are not UTF-8 text") from error
    version = metadata.get("format_version", "none")
    if inputs != INPUTS or outputs != OUTPUT or version != str(FORMAT_VERSION):
        given, made = (
            _shorten(", ".join(f"{name} {kind}" for name, kind in values.items()))
            for values in (inputs, outputs)
        )
        raise ModelError(
            f"{path} is no super-sdf network of format {FORMAT_VERSION} (format {_shorten(version)}"
            f", inputs {given}, outputs {made}); export one with export/to_onnx.py"
        )
    card = {key: _parse(key, text, path) for key, text in metadata.items()}
    for key, (name, unit, most) in WHOLE.items():
        value = card.get(key, 1)
        if type(value) is not int or not 1 <= value <= most:  # True is an int, too
            raise ModelError(
                f"{path}: its {name} is {_shorten(repr(value))}; it must be a whole number of "
                f"{unit} from 1 to {most}: export it again with export/to_onnx.py"
            )
    return card


def _shorten(text: str) -> str:
    """Return text from a file as part of one line, cut to ``MAX_SHOWN`` characters."""
    line = " ".join(text.split())
    return line if len(line) <= MAX_SHOWN else f"{line[:MAX_SHOWN]}..."


def _parse(key: str, text: str, path: Path) -> Any:
    """Return a metadata value parsed as JSON, or as text if it is not JSON."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
    except (ValueError, RecursionError) as error:  # thousands of digits; nested too deep
        raise ModelError(
            f"{path}: its metadata {_shorten(key)!r} cannot be read, {_shorten(text)!r}; export it "
            "again with export/to_onnx.py"
        ) from error
