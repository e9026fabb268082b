"""The ONNX file's contract, and devices asked for."""

import numpy as np
import pytest
from conftest import ball

from super_sdf import load_network
from super_sdf.band import find_band, gather_patches, neighbour_table, rescale
from super_sdf.errors import DeviceError, FileError, ModelError, OptionError
from super_sdf.network import QUALITIES, shipped_models
from super_sdf.nodes import block_offsets


def network_inputs(grid):
    field = rescale(grid)
    voxels = find_band(field)
    rows = np.arange(len(voxels), dtype=np.int32)
    return gather_patches(field, voxels), neighbour_table(voxels, grid.shape), rows


def test_the_card_says_what_the_file_is():
    card = load_network("base").card
    for key in (
        "receptive_field",
        "value_scaling",
        "training_factors",
        "trained_on",
        "trained_from_commit",
        "accuracy",
        "licence",
        "parameters",
    ):
        assert card[key], key


def test_voxels_and_offsets_may_be_asked_in_any_order():
    patches, table, rows = network_inputs(ball())
    network, offsets = load_network(), block_offsets(2)
    whole = network(patches, table, rows, offsets)
    some = network(patches, table, rows[::-3].copy(), offsets[::-2].copy())
    np.testing.assert_allclose(some, whole[::-3, ::-2], atol=1e-5)


def test_a_prediction_depends_on_the_receptive_field_and_no_more():
    patches, table, rows = network_inputs(ball())
    network = load_network()
    voxels = find_band(rescale(ball()))
    reach = network.card["receptive_field"]
    before = network(patches, table, rows[:1], block_offsets(2))
    far = np.abs(voxels - voxels[0]).max(1) >= reach
    patches[far] += 1
    np.testing.assert_array_equal(network(patches, table, rows[:1], block_offsets(2)), before)
    near = np.abs(voxels - voxels[0]).max(1) == 2
    patches[near] += 1
    assert (network(patches, table, rows[:1], block_offsets(2)) != before).any()


def test_shipped_networks_are_small_and_keep_the_contract():
    names = {name for name, _ in QUALITIES.values()}
    assert {name.removesuffix("-int8") for name in shipped_models()} == names
    for name, path in shipped_models().items():
        assert path.stat().st_size < 8e6
        assert load_network(name).card["name"] == name


@pytest.mark.parametrize("factor", [4, 8])
def test_a_prediction_depends_neither_on_threads_nor_on_what_else_is_asked(factor):
    """To the last bit: so a mesh may be made in slabs, or by another number of threads."""
    patches, table, rows = network_inputs(ball())
    offsets = block_offsets(factor)
    one, two = (load_network("fast", threads=threads) for threads in (1, 2))
    values = one(patches, table, rows, offsets)
    for some in (rows, rows[40:], rows[100:103], rows[7:8]):
        np.testing.assert_array_equal(two(patches, table, some, offsets), values[some])


def test_int8_is_near_float32_and_says_what_it_is():
    patches, table, rows = network_inputs(ball())
    one, other = load_network(), load_network(precision="int8")
    assert other.card["precision"] == "int8" and other.device == "cpu"
    given = patches, table, rows, block_offsets(4)
    apart = np.abs(one(*given) - other(*given)) / 2  # voxels
    assert 0 < apart.mean() < 2e-3 and apart.max() < 0.05


def test_int8_gives_the_same_bits_for_any_part_and_any_threads():
    """So it does for any slabs: who else is in the call makes no difference."""
    grid = ball(36, 13.0)
    field = rescale(grid)
    voxels = find_band(field)
    rows = np.arange(len(voxels), dtype=np.int32)
    patches, table = gather_patches(field, voxels), neighbour_table(voxels, grid.shape)
    network = load_network(precision="int8", threads=1)
    whole = network(patches, table, rows, block_offsets(4))
    pair = load_network(precision="int8", threads=2)
    np.testing.assert_array_equal(pair(patches, table, rows, block_offsets(4)), whole)
    for first, last in ((10, 12), (12, 25)):
        wanted = (voxels[:, 0] >= first) & (voxels[:, 0] < last)
        reach = network.card["receptive_field"]
        near = (voxels[:, 0] >= first - reach) & (voxels[:, 0] < last + reach)
        some_table = neighbour_table(voxels[near], grid.shape)
        some = np.flatnonzero(wanted[near]).astype(np.int32)
        part = network(patches[near], some_table, some, block_offsets(4))
        np.testing.assert_array_equal(part, whole[wanted])


def test_int8_of_what_has_none_is_an_error(tmp_path):
    with pytest.raises(
        OptionError, match=r"none\.onnx has no int8 variant, .*none-int8\.onnx: write"
    ):
        load_network(tmp_path / "none.onnx", precision="int8")
    with pytest.raises(OptionError, match="precision is 'int4': give one of float32, int8"):
        load_network(precision="int4")
    with pytest.raises(DeviceError, match="int8 is for the CPU: use --precision float32"):
        load_network(precision="int8", device="cuda")


def test_a_failing_run_is_one_error_of_ours():
    patches, table, rows = network_inputs(ball())
    with pytest.raises(DeviceError, match="the network failed on cpu: "):
        load_network()(patches, table, rows + 10**6, block_offsets(2))


def test_what_is_no_network_is_refused(tmp_path):
    with pytest.raises(
        FileError, match="no model 'other': give an ONNX file or one of: fast, base, best"
    ):
        load_network("other")
    (tmp_path / "bad.onnx").write_bytes(b"not a graph")
    with pytest.raises(ModelError, match=r"bad\.onnx is no ONNX file that onnxruntime can run"):
        load_network(tmp_path / "bad.onnx")
    with pytest.raises(DeviceError, match="device is 'tpu': give one of auto, cpu, cuda"):
        load_network(device="tpu")
