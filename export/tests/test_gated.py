"""Networks whose last blocks run only where much is lost: training, as files, in whole numbers."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch

from export.augment import draw_samples, prepare
from export.batches import batch_of, encode
from export.gates import correlation, encode_first, measure_at, rows_of_table, threshold_of
from export.grow import grow_from, without_blocks
from export.network import GatherMatMul, SuperSdfNet
from export.onnx_graph import THRESHOLD
from export.quantize import distance_apart, quantize
from export.recipe import RECIPE, batch_losses, measure, window_losses
from export.resident import Residents, gather_samples
from export.tests.small_net import SMALL
from export.tests.test_resident import turned_one_by_one
from export.to_onnx import make_card, noisy_ball, parity, read_network, write_model
from super_sdf.errors import OptionError
from super_sdf.network.neighbourhood import CENTRE
from super_sdf.network.contract import INPUTS
from super_sdf.network.network import load_network, shipped_models
from super_sdf.network.onnx import CHUNK_INPUT, ort
from super_sdf.refine.band import DECODE_LIMIT

CONFIG = replace(SMALL, channels=16, hidden=32, blocks=4, gated=2)
ALWAYS, NEVER = -1e9, 1e9


def ball_tensors():
    """The noisy ball as the blocks get it: patches and table."""
    patches, table, *_ = map(torch.from_numpy, noisy_ball())
    return patches, torch.where(table < 0, len(patches), table)


@pytest.fixture
def net():
    """A network away from the start; its gate is open for half of the noisy ball."""
    torch.manual_seed(0)
    net = SuperSdfNet(CONFIG)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    with torch.no_grad():
        net.gate.threshold.fill_(net.encode_all(*ball_tensors()).doubts.quantile(0.5))
    return net.eval()


@torch.no_grad()
def test_the_last_blocks_on_all_voxels_are_those_of_a_plain_network(net):
    patches, table = ball_tensors()
    first, everywhere = net.encode(patches, table), torch.arange(len(patches))
    deep = net.deepen(first, table, everywhere)
    for blocks, found in ((2, first), (4, deep)):
        plain = SuperSdfNet(replace(CONFIG, blocks=blocks, gated=0))
        weights = {name: array for name, array in net.state_dict().items() if "gate" not in name}
        grow_from(plain, without_blocks(weights, range(blocks, CONFIG.blocks)))
        torch.testing.assert_close(found, plain.encode(patches, table))
    assert net.deepen(first, table, everywhere[:0]).shape == (0, CONFIG.channels)
    alone = net.deepen(first, table, torch.tensor([7]))
    blended = net.blend(net.encode_all(patches, table), table, torch.tensor([7])).features
    others = torch.arange(len(patches)) != 7
    torch.testing.assert_close(blended[others], net.early(first, table)[others])
    torch.testing.assert_close(blended[7:8], alone)


def test_the_gradient_of_a_convolution_with_voxels_around(monkeypatch):
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


def test_the_gate_opens_for_a_share_of_the_voxels_that_can_hold_the_surface(net):
    patches, _ = ball_tensors()
    doubts = torch.randn(len(patches))
    near = patches[:, CENTRE].abs() <= DECODE_LIMIT
    before = float(net.gate.threshold)
    rows = net.gate.rows(doubts, patches, 0.25)
    assert near[rows].all() and not near.all()
    assert len(rows) == pytest.approx(0.25 * int(near.sum()), abs=1)
    assert doubts[rows].min() > torch.tensor(sorted(doubts[near]))[: -len(rows)].max()
    usual = float(doubts[near].quantile(0.7))
    assert float(net.gate.threshold) == pytest.approx(before + 0.01 * (usual - before))
    net.gate.threshold.fill_(ALWAYS)
    assert net.gate.rows(doubts, patches).tolist() == torch.nonzero(near)[:, 0].tolist()


@pytest.fixture
def file(net, tmp_path):
    path = tmp_path / "gated.onnx"
    write_model(net, path, make_card(net, "gated", "nothing", "none"))
    return path


def test_the_file_agrees_with_torch_and_is_read_back(net, file):
    patches, table = ball_tensors()
    rows = net.gate.rows(net.encode_all(patches, table).doubts, patches)
    assert 0.2 < len(rows) / len(patches) < 0.6
    assert parity(net, file) < 2e-5
    again = read_network(file)
    assert again.config == CONFIG
    assert load_network(file).card["receptive_field"] == CONFIG.blocks + 1
    for name, array in net.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], array)


def test_who_runs_the_file_may_set_the_threshold_and_the_chunk(net, file):
    session, feeds = load_network(file, device="cpu").session, dict(zip(INPUTS, noisy_ball()))
    found = []
    for threshold in (ALWAYS, float(net.gate.threshold), NEVER):
        given = {**feeds, THRESHOLD: np.array([threshold], np.float32)}
        net.gate.threshold.fill_(threshold)
        with torch.no_grad():
            want = net(*map(torch.from_numpy, noisy_ball())).numpy()
        for rows in (7, 512):
            found.append(session.run(None, {**given, CHUNK_INPUT: np.array([rows])})[0])
            np.testing.assert_allclose(found[-1], want, atol=2e-5)
    assert min(np.abs(found[0] - other).max() for other in found[2::2]) > 1e-3


def test_a_voxel_sees_no_farther_than_the_receptive_field(net, file):
    network, (patches, table, voxels, offsets) = load_network(file), noisy_ball()
    whole = network(patches, table, voxels, offsets)
    reached = np.zeros(len(patches), bool)
    reached[voxels[0]] = True
    for _ in range(CONFIG.receptive_field - 1):  # a patch itself reaches one voxel
        around = table[reached]
        reached[around[around >= 0]] = True
    assert not reached.all()
    changed = np.where(reached[:, None], patches, patches + 0.3).astype(np.float32)
    np.testing.assert_array_equal(network(changed, table, voxels, offsets)[0], whole[0])


def test_the_int8_file_is_near_and_runs_every_layer_in_whole_numbers(net, file, tmp_path):
    samples = draw_samples(4)
    small = file.with_name("gated-int8.onnx")
    quantize(file, small, samples)
    apart = distance_apart(file, small, samples)
    assert 0 < apart.mean() < 3e-3
    options = ort.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    ort.InferenceSession(str(small), options, providers=["CPUExecutionProvider"])
    nodes = onnx.load(tmp_path / "optimised.onnx").graph.node
    bodies = [a.g for node in nodes for a in node.attribute if a.name == "body"]
    kinds = {body.name: [node.op_type for node in body.node] for body in bodies}
    layers = ["QGemm"] * 3 + ["Add"]
    for number in range(CONFIG.blocks):
        rounding = ["QuantizeLinear"] * (number < CONFIG.blocks - 1)
        assert kinds[f"block{number}"] == ["Gather", "Gather", "Reshape", *layers, *rounding]


@pytest.fixture(scope="module")
def prepared(samples):
    return [prepare(sample) for sample in samples]


def test_samples_on_a_device_have_the_same_losses_and_the_gate_learns(net, prepared):
    residents = Residents("cpu")
    residents.add(gather_samples(prepared))
    found = []
    for batch in (
        residents.batch([2, 0, 1, 2], [0, 5, 17, 40]),
        batch_of(list(turned_one_by_one(prepared))),
    ):
        torch.manual_seed(3)
        found.append(window_losses(net, batch, RECIPE))
    torch.testing.assert_close(*found)
    found[0].sum().backward()
    for part in (net.gate.layers[2], net.blocks[0].conv, net.blocks[3].conv):
        assert part.weight.grad.abs().max() > 0


@torch.no_grad()
def test_errors_at_a_threshold_are_those_of_the_network_with_it(net, prepared):
    encoded, seen = encode_first(net, prepared), []
    for share in (0.0, 0.3, 1.0):
        threshold = threshold_of(encoded, share)
        seen.append(measure_at(net, prepared, encoded, threshold))
        assert seen[-1][1] == measure(net, prepared)
    can_hold = np.mean([len(each.voxels) for each in prepared])
    can_hold /= np.mean([len(each.patches) for each in prepared])
    assert [band for band, _ in seen] == pytest.approx([0, 0.3 * can_hold, can_hold], abs=0.02)
    assert len({errors for _, errors in seen}) == 3


@torch.no_grad()
def test_what_the_gate_says_is_ranked_against_the_loss(net, prepared):
    encoded = encode_first(net, prepared)
    batch = batch_of(prepared)
    losses = batch_losses(net, batch, encode(net, batch), RECIPE)
    ends = np.cumsum([len(each.voxels) for each in prepared])[:-1].tolist()
    for each, first, loss in zip(prepared, encoded, losses.tensor_split(ends)):
        first.doubts[each.voxels] = -loss
    assert correlation(net, prepared, encoded) == pytest.approx(-1)


def test_a_network_without_a_gate_has_no_thresholds(tmp_path):
    for number in range(3):
        (tmp_path / f"shard-{number}.npz").touch()
    file = shipped_models()["fast"]
    with pytest.raises(OptionError, match=r"fast.onnx has no gate: give a network .* --gated$"):
        next(rows_of_table(file, tmp_path, (0.5,)))
