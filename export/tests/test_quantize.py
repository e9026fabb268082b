"""From float32 to int8: rounding, what onnxruntime makes of the graph."""

import numpy as np
import onnx
import pytest
import torch

from export.augment import draw_samples
from export.network import NetworkConfig, SuperSdfNet
from export.quantize import (
    LEVELS,
    MOST,
    distance_apart,
    quantize,
    whole_layer,
)
from export.to_onnx import make_card, write_model
from super_sdf.network.network import load_network, shipped_models

SMALL = NetworkConfig(channels=16, blocks=3, hidden=32, functions=24, trunk=16, frequencies=2)


@pytest.fixture(scope="module")
def calibration():
    return draw_samples(4)


@pytest.fixture(scope="module")
def files(tmp_path_factory, calibration):
    """A network in float32, and twice in int8."""
    torch.manual_seed(0)
    net = SuperSdfNet(SMALL)
    for block in net.blocks:  # away from the start, where the blocks do nothing
        torch.nn.init.normal_(block.reduce.weight, std=0.1)
    folder = tmp_path_factory.mktemp("files")
    paths = [folder / name for name in ("small.onnx", "small-int8.onnx", "again.onnx")]
    write_model(net, paths[0], make_card(net, "small", "nothing", "none"))
    quantize(paths[0], paths[1], calibration)
    quantize(paths[0], paths[2], calibration)
    return paths


def test_a_rounded_layer_is_near_and_zero_is_exact():
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    weight, bias = torch.randn(27 * 4, 5), torch.randn(5)
    steps, zeros = rng.uniform(0.01, 0.02, 4), rng.integers(0, 255, 4)
    layer = whole_layer(weight, bias, np.tile(steps, 27), np.full(5, 0.5), zeros)
    assert layer.weight.dtype == np.int8 and np.abs(layer.weight).max() == MOST
    absent = np.tile(zeros, 27) @ layer.weight.astype(int) + layer.bias
    assert np.abs(absent * layer.scales * 0.5 - bias.numpy()).max() <= layer.scales.max()
    read = rng.integers(0, LEVELS + 1, (100, 27 * 4))
    got = (read @ layer.weight.astype(int) + layer.bias) * layer.scales * 0.5
    want = ((read - np.tile(zeros, 27)) * np.tile(steps, 27)) @ weight.numpy() + bias.numpy()
    assert np.abs(got - want).mean() < 0.02 * np.abs(want).mean()


def test_layers_without_weights_keep_their_bias_and_no_pair_of_products_is_cut_off():
    assert 2 * LEVELS * MOST < 2**15  # on processors without VNNI
    bias = torch.tensor([3.0, 0.0])
    layer = whole_layer(torch.zeros(4, 2), bias, np.ones(4), np.ones(2))
    np.testing.assert_allclose(layer.bias * layer.scales, bias, rtol=1e-6)


def test_the_int8_file_is_near_the_float32_one_carries_its_card_and_is_written_again(
    files, calibration
):
    """What onnxruntime makes of its layers: test_gated."""
    assert distance_apart(*files[:2], calibration).mean() < 3e-3
    card = load_network(files[1]).card
    assert (card["name"], card["precision"], card["receptive_field"]) == ("small-int8", "int8", 4)
    assert load_network(files[0], precision="int8").card == card  # the one beside it
    one, other = (onnx.load(path) for path in files[1:])
    assert one.graph == other.graph


def test_nothing_stands_between_a_product_and_its_rounding(files):
    """Rounding rectifies; with a Relu there, onnxruntime 1.21 to 1.30 refuse their own graph."""
    for path in (files[1], *(path for name, path in shipped_models().items() if "-int8" in name)):
        nodes = onnx.load(path).graph.node
        for body in (a.g for node in nodes for a in node.attribute if a.name == "body"):
            made = {node.output[0]: node.op_type for node in body.node}
            rounded = [node for node in body.node if node.op_type == "QuantizeLinear"]
            assert {made[node.input[0]] for node in rounded} <= {"Gemm", "Add", "Mul"}, path
