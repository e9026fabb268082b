"""Networks as files: the same values as in PyTorch, in chunks of any size and in whole numbers."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch

from export import to_onnx
from export.augment import draw_samples
from export.network import SIZES, GatherMatMul, SuperSdfNet, is_noisy
from export.onnx_graph import THRESHOLD
from export.quantize import distance_apart, quantize
from export.tests.conftest import SMALL
from export.to_onnx import make_card, noisy_ball, parity, read_network, write_model
from super_sdf import load_network
from super_sdf.errors import ModelError
from super_sdf.network import contract, network as networks, onnx as sessions
from super_sdf.refine import band


def ball_tensors():
    """The noisy ball as the blocks get it: patches and table."""
    patches, table, *_ = map(torch.from_numpy, noisy_ball())
    return patches, torch.where(table < 0, len(patches), table).long()


@pytest.fixture
def file(net, tmp_path):
    if net.config.gated:
        with torch.no_grad():
            net.gate.threshold.fill_(net.encode_all(*ball_tensors()).doubts.quantile(0.5))
    write_model(net, tmp_path / "small.onnx", make_card(net, "small"))
    return tmp_path / "small.onnx"


def test_the_file_agrees_with_torch_in_chunks_of_any_size_and_is_read_back(net, file):
    assert parity(net, file) < 2e-5
    loaded, feeds = load_network(file, device="cpu"), dict(zip(contract.INPUTS, noisy_ball()))
    assert loaded.card["receptive_field"] == SMALL.blocks + 1
    want = loaded.session.run(None, feeds)[0]
    for rows in (7, 512, 10**4):
        got = loaded.session.run(None, {**feeds, sessions.CHUNK_INPUT: np.array([rows])})[0]
        np.testing.assert_allclose(got, want, atol=1e-5)
    again = read_network(file)
    assert again.config == net.config
    for name, array in net.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], array)
    if net.config.gated:
        shut = loaded.session.run(None, {**feeds, THRESHOLD: np.array([1e9], np.float32)})[0]
        net.gate.threshold.fill_(1e9)
        with torch.no_grad():
            np.testing.assert_allclose(shut, net(*map(torch.from_numpy, noisy_ball())), atol=2e-5)
        assert np.abs(shut - want).max() > 1e-3


def test_a_voxel_sees_no_farther_than_the_receptive_field(net, file):
    network, (patches, table, voxels, offsets) = load_network(file), noisy_ball()
    whole = network(patches, table, voxels, offsets)
    reached = np.zeros(len(patches), bool)
    reached[voxels[0]] = True
    for _ in range(SMALL.receptive_field - 1):  # a patch itself reaches one voxel
        around = table[reached]
        reached[around[around >= 0]] = True
    assert not reached.all()
    changed = np.where(reached[:, None], patches, patches + 0.3).astype(np.float32)
    np.testing.assert_array_equal(network(changed, table, voxels, offsets)[0], whole[0])


def test_networks_keep_samples_unless_they_are_noisy_or_of_masks(tmp_path):
    patches, table = torch.rand(1, 27), torch.full((1, 27), -1)
    for keeps in (True, False):
        net = SuperSdfNet(replace(SMALL, keeps_samples=keeps))
        torch.nn.init.constant_(net.correction.bias, 0.5)
        at_sample = float(net(patches, table, torch.tensor([0]), torch.zeros(1, 3)).detach())
        assert (at_sample == pytest.approx(float(patches[0, 13]), abs=1e-5)) == keeps
    write_model(net, tmp_path / "mask.onnx", make_card(net, "mask"))
    assert load_network(tmp_path / "mask.onnx").card["inputs"] == contract.MASKS
    assert not read_network(tmp_path / "mask.onnx").config.keeps_samples
    patches, table = ball_tensors()
    broken = ~band.is_lipschitz(patches.numpy())
    near = np.append(broken, False)[table.numpy()].any(1)
    np.testing.assert_array_equal(is_noisy(patches, table)[:, 0].numpy() > 0, near)


def test_the_gradient_of_a_convolution_in_chunks_and_with_voxels_around(monkeypatch):
    monkeypatch.setattr("export.network.CHUNK", 5)
    patches, table = ball_tensors()
    rows = torch.arange(40, 52)
    place = torch.arange(len(patches) + 1) + len(rows)
    place[rows] = torch.arange(len(rows))
    features = torch.randn(len(rows), 3, dtype=torch.double, requires_grad=True)
    weight = torch.randn(81, 2, dtype=torch.double, requires_grad=True)
    around = torch.randn(len(patches), 3, dtype=torch.double)
    assert torch.autograd.gradcheck(
        lambda f, w: GatherMatMul.apply(f, w, place[table[rows]], around), (features, weight)
    )


def test_the_int8_file_is_near_holds_the_optimised_graph_and_runs_in_whole_numbers(net, file):
    """Rounding rectifies; with a Relu there, onnxruntime 1.21 to 1.30 refuse their own graph."""
    samples, target = draw_samples(4), file.with_name("small-int8.onnx")
    quantize(file, target, samples)
    assert np.abs(distance_apart(file, target, samples)).mean() < 5e-3
    card = load_network(target).card
    assert (card["name"], card["precision"]) == ("small-int8", "int8")
    assert "optimised_by" in card and "optimised_by" not in load_network(file).card
    scans = [node for node in onnx.load(target).graph.node if node.op_type == "Scan"]
    bodies = [a.g for scan in scans for a in scan.attribute if a.name == "body"]
    kinds = {body.name: [node.op_type for node in body.node] for body in bodies}
    for number in range(SMALL.blocks):
        seen = net.blocks[min(number + 1, SMALL.blocks - 1)].conv.seen
        rounding = ["Slice"] * (seen < SMALL.channels)
        rounding += ["QuantizeLinear"] * (number < SMALL.blocks - 1)
        layers = ["QGemm"] * 3 + ["Add"] + rounding
        assert kinds[f"block{number}"] == ["Gather", "Gather", "Reshape", *layers]
    with pytest.raises(ModelError, match="is an int8 network: give the float32 network"):
        read_network(target)


@pytest.mark.parametrize("name", SIZES)
def test_a_size_is_that_of_the_shipped_network_whose_int8_file_is_optimised(name):
    files = networks.shipped_models()
    assert read_network(files[name]).config == SIZES[name]
    cards = [load_network(files[each]).card for each in (name, f"{name}-int8")]
    same = ("receptive_field", "trained_on", "trained_from_commit", "parameters")
    assert "optimised_by" in cards[1]
    assert [cards[0][key] for key in same] == [cards[1][key] for key in same]


def test_a_file_is_written_anew_with_the_same_values_and_card(tmp_path):
    shipped = networks.shipped_models()["fast"]
    to_onnx.main(["--from", str(shipped), "--out", str(tmp_path / "fast.onnx")])
    one, other = load_network(shipped, device="cpu"), load_network(tmp_path / "fast.onnx")
    assert one.card == other.card and [path.name for path in tmp_path.iterdir()] == ["fast.onnx"]
    values = [each(*noisy_ball()) for each in (one, other)]
    np.testing.assert_allclose(*values, rtol=0, atol=2e-6)
