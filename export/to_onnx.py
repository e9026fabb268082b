"""Export a trained network as the ONNX file that the runtime loads, and check that they agree.

    python -m export.to_onnx --run training/run --out base.onnx --data "..." --accuracy "..."
    python -m export.to_onnx --from base.onnx --out base.onnx   # the same in the current graph

The result is kept only if its values are those of PyTorch to 1e-4 of a voxel.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper

from export.arguments import Parser
from export.network import NetworkConfig, SuperSdfNet
from export.onnx_graph import build_graph
from super_sdf import load_network
from super_sdf.errors import ModelError, OptionError
from super_sdf.grid.derived import BLURRED
from super_sdf.network import contract
from super_sdf.refine import band, nodes

OPSET = 18
PARITY = 2e-4  # half voxels: 1e-4 of a voxel


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Return the parameters and buffers of an exported file; ModelError if its blocks are int8."""
    graphs = [onnx.load(path).graph]
    graphs += [a.g for node in graphs[0].node for a in node.attribute if a.name == "body"]
    arrays = {i.name: numpy_helper.to_array(i).copy() for g in graphs for i in g.initializer}
    if any("_int8_" in name for name in arrays):
        raise ModelError(f"{path} is an int8 network: give the float32 network it was made from")
    linear = {name for name, array in arrays.items() if array.ndim == 2 and "conv" not in name}
    return {
        name: torch.from_numpy(array.T.copy() if name in linear else array)
        for name, array in arrays.items()
        if "." in name
    }


def write_model(net: SuperSdfNet, path: Path, card: dict[str, Any]) -> None:
    imports = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(build_graph(net), opset_imports=imports, ir_version=9)
    model.producer_name = "super-sdf"
    helper.set_model_props(model, {key: str(value) for key, value in card.items()})
    onnx.checker.check_model(model)
    onnx.save(model, path)


def noisy_ball(seed: int = 0, wide: int = 0) -> tuple[np.ndarray, ...]:
    """Return inputs to compare networks on: noisy, and with voxels that are not decoded."""
    rng = np.random.default_rng(seed)
    ijk = np.indices((24, 20, 22))
    radius = np.linalg.norm(ijk - np.array([11, 9, 10])[:, None, None, None], axis=0)
    rescaled = (2 * (radius - 7) + rng.normal(0, 0.3, radius.shape)).astype(np.float32)
    ijk = np.argwhere(band.is_active(rescaled)).astype(np.int32)
    patches, table = band.gather_patches(rescaled, ijk), band.neighbour_table(ijk, rescaled.shape)
    others = rng.normal(0, 1, (len(ijk), wide)).astype(np.float32)
    voxels = np.flatnonzero(rng.random(len(ijk)) < 0.7).astype(np.int32)
    return np.hstack([patches, others]), table, voxels, nodes.block_offsets(4)


def parity(net: SuperSdfNet, path: Path, seed: int = 0) -> float:
    """Return the largest difference (half voxels) between torch and onnxruntime on a noisy ball."""
    arrays = noisy_ball(seed, net.config.wide)
    got = load_network(path, device="cpu")(*arrays)
    with torch.no_grad():
        want = net(*(torch.from_numpy(array) for array in arrays))
    return float(np.abs(got - want.numpy()).max())


def load_run(folder: Path) -> SuperSdfNet:
    state = torch.load(folder / "checkpoint.pt", weights_only=True, map_location="cpu")
    net = SuperSdfNet(NetworkConfig(**state["config"]))
    net.load_state_dict(state["average"])
    return net.eval()


def read_network(path: Path) -> SuperSdfNet:
    weights, card = read_weights(path), read_card(path)
    trunk, inputs = weights["trunk.layers.0.weight"].shape
    channels = len(weights["correction.weight"][0])
    convs = {name for name in weights if name.endswith("conv.weight")}
    early = convs & {"early.conv.weight"}
    in_order = [*(f"blocks.{number}.conv.weight" for number in range(len(convs - early))), *early]
    gated, seen = (int(card.get(name, 0)) for name in ("gated", "seen"))
    first = len(convs - early) - gated
    places = tuple(
        len(weights[name]) // (seen if seen and number < first else channels)
        for number, name in enumerate(in_order)
    )
    config = NetworkConfig(
        channels=channels,
        blocks=len(convs - early),
        hidden=len(weights["stem.0.bias"]),
        functions=channels + len(weights["branch.bias"]),
        trunk=trunk,
        frequencies=(inputs - 3) // 6,
        keeps_samples=card.get("inputs") != contract.MASKS,
        wide=weights["stem.0.weight"].shape[1] - 27,
        gated=gated,
        seen=seen,
        places=() if set(places) == {27} else places,
    )
    net = SuperSdfNet(config)
    net.load_state_dict(weights)
    return net.eval()


def read_card(path: Path) -> dict[str, str]:
    return {prop.key: prop.value for prop in onnx.load(path).metadata_props}


def make_card(net: SuperSdfNet, name: str) -> dict[str, Any]:
    """Return the metadata of the file, which the runtime shows."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    return {
        "format_version": contract.FORMAT_VERSION,
        "name": name,
        "band": "abs(value) < 1.5 h",
        "receptive_field": net.config.receptive_field + BLURRED * bool(net.config.wide),
        "channels": net.config.channels,
        "value_scaling": "2 / h",
        "training_factors": [2, 4, 8, 16],
        "parameters": sum(p.numel() for p in net.parameters()),
        "trained_on": "not given",
        "trained_from_commit": commit,
        "accuracy": "not measured",
        "licence": "MIT",
        **({} if net.config.keeps_samples else {"inputs": contract.MASKS}),
        **{name: n for name in ("gated", "wide", "seen") if (n := getattr(net.config, name))},
    }


def main(words: Sequence[str] | None = None) -> None:
    """Export a run, or rewrite a file; keep the result only if it agrees with PyTorch."""
    parser = Parser(description=__doc__.split("\n")[0])
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--run", type=Path, help="folder of the run")
    source.add_argument("--from", type=Path, dest="source", help="an .onnx file to rewrite")
    parser.add_argument("--out", type=Path, required=True, help="the .onnx file")
    parser.add_argument("--data", help="what it was trained on")
    parser.add_argument("--accuracy", help="measured figures, in words")
    exact = "it was trained on hardly any noisy samples: noisy grids are for another network"
    parser.add_argument("--exact", action="store_true", help=exact)
    gate = "of the gate, the logarithm of a loss, if not that of the run"
    parser.add_argument("--threshold", type=float, help=gate)
    options = parser.parse_args(words)
    with parser.one_line_errors():
        export(options)


def export(options: argparse.Namespace) -> None:
    """Write the file and say how far it is from PyTorch; OptionError if an option does not fit."""
    net = read_network(options.source) if options.source else load_run(options.run)
    card = read_card(options.source) if options.source else make_card(net, options.out.stem)
    if options.threshold is not None:
        if not net.config.gated:
            raise OptionError("--threshold is of a gate, which this network lacks: leave it out")
        net.gate.threshold.fill_(options.threshold)
    if options.exact:
        if not net.config.keeps_samples:
            raise OptionError("--exact is for distances, this network for masks: leave it out")
        card["inputs"] = contract.EXACT_DISTANCES
    said = {"trained_on": options.data, "accuracy": options.accuracy}
    card |= {name: text for name, text in said.items() if text}
    fresh = options.out.with_suffix(".new.onnx")  # the target may be the source
    write_model(net, fresh, card)
    difference = parity(net, fresh)
    if difference > PARITY:
        fresh.unlink()
        raise SystemExit(f"torch and onnxruntime differ by {difference / 2:.2e} voxels: not kept")
    fresh.replace(options.out)
    size = options.out.stat().st_size / 1e6
    print(f"{options.out}: {size:.1f} MB, differs from torch by {difference / 2:.1e} voxels")


if __name__ == "__main__":
    main()
