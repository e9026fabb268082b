"""The contract of the ONNX file, the values of a network, and the errors of bad files."""

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ball, refusal
from onnx import TensorProto
from onnx_files import write_network

from super_sdf import load_network, reconstruct
from super_sdf.errors import DeviceError, FileError, ModelError, OptionError
from super_sdf.network.network import KIND_MODELS, shipped_models
from super_sdf.options import QUALITIES
from super_sdf.refine.band import gather_patches, is_active, neighbour_table, rescale
from super_sdf.refine.nodes import block_offsets


def network_inputs(field):
    """Return what a network is given for a field in half voxels."""
    voxels = np.argwhere(is_active(field)).astype(np.int32)
    rows = np.arange(len(voxels), dtype=np.int32)
    return gather_patches(field, voxels), neighbour_table(voxels, field.shape), rows


def test_shipped_networks_are_small_and_fulfil_the_contract():
    names = {*(name for name, _ in QUALITIES.values()), *KIND_MODELS}
    assert {name.removesuffix("-int8") for name in shipped_models()} == names
    for name, path in shipped_models().items():
        assert path.stat().st_size < 20e6
        card = load_network(name, precision="float32").card
        assert card["name"] == name and card["receptive_field"] and card["parameters"]
        assert card["trained_on"] and card["trained_from_commit"] and card["accuracy"]


@pytest.mark.parametrize("name, precision, factor", [("fast", "float32", 8), ("base", "int8", 4)])
def test_a_prediction_depends_neither_on_threads_nor_on_other_voxels(name, precision, factor):
    """Bit for bit, so that a mesh does not depend on its slabs or on the number of threads."""
    grid = ball(30, 11.0)
    patches, table, rows = network_inputs(rescale(grid))
    voxels, offsets = np.argwhere(is_active(rescale(grid))), block_offsets(factor)
    one, two = (load_network(name, threads=n, precision=precision) for n in (1, 2))
    whole = one(patches, table, rows, offsets)
    for some in (rows, rows[40:], rows[7:8]):
        np.testing.assert_array_equal(two(patches, table, some, offsets), whole[some])
    reach = one.card["receptive_field"]
    for first, last in ((8, 10), (10, 21)):  # as slabs: those beyond the reach are not there
        wanted = (voxels[:, 0] >= first) & (voxels[:, 0] < last)
        near = (voxels[:, 0] >= first - reach) & (voxels[:, 0] < last + reach)
        some = np.flatnonzero(wanted[near]).astype(np.int32)
        part = one(patches[near], neighbour_table(voxels[near], grid.shape), some, offsets)
        np.testing.assert_array_equal(part, whole[wanted])


def test_shipped_networks_run_in_int8_on_the_cpu_and_other_files_as_they_are(tmp_path):
    given = *network_inputs(rescale(ball())), block_offsets(4)
    for quality in QUALITIES:
        whole, real = (load_network(quality, precision=p) for p in ("auto", "float32"))
        assert (whole.precision, whole.device, real.precision) == ("int8", "cpu", "float32")
        apart = np.abs(whole(*given) - real(*given)) / 2  # voxels
        assert 0 < apart.mean() < 3e-3 and apart.max() < 0.06
    own = shutil.copy(shipped_models()["base"], tmp_path / "own.onnx")
    shutil.copy(shipped_models()["base-int8"], tmp_path / "own-int8.onnx")
    assert load_network(own, device="cpu").precision == "float32"
    assert load_network(own, precision="int8").precision == "int8"


REFUSED = [
    (FileError, r"no model 'none-int8\.onnx': give", {"model": "none.onnx", "precision": "int8"}),
    (DeviceError, "int8 is for the CPU: use precision='float32'",
     {"precision": "int8", "device": "cuda"}),
    (OptionError, "device is 'tpu': give one of auto, cpu, cuda", {"device": "tpu"}),
]  # fmt: skip


@pytest.mark.parametrize("error, message, asked", REFUSED)
def test_names_files_and_devices_that_do_not_exist_are_refused(error, message, asked):
    with pytest.raises(error, match=message):
        load_network(**asked)


def test_any_file_that_fulfils_the_contract_runs_also_without_a_receptive_field(tmp_path):
    card = {"format_version": "1", "note": "not JSON"}
    network = load_network(write_network(tmp_path / "own.onnx", card=card), device="cpu")
    assert network.receptive_field is None and network.card["note"] == "not JSON"
    assert len(reconstruct(ball(), network).faces)


# What a network is written with, and the error.
OF_FORMAT = r"is no super-sdf network of format 1 "
WRONG = {
    "double": (
        {"last": ("Cast", "sum"), "kind": TensorProto.DOUBLE},
        OF_FORMAT + r".*outputs \{'values': 'tensor\(double\)'\}\)",
    ),
    "no version": ({"card": {}}, OF_FORMAT + r"\(format None, inputs \{'patches'"),
    "negative field": (
        {"card": {"format_version": "1", "receptive_field": "-5"}},
        OF_FORMAT + r"\(receptive_field -5\)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_network_with_another_output_or_invalid_metadata_is_an_error_of_one_line(tmp_path, name):
    given, message = WRONG[name]
    path = write_network(tmp_path / "own.onnx", **given)
    said = refusal(ModelError, load_network, path, device="cpu")
    assert re.match(f"{path} {message}", said), said


@pytest.mark.parametrize(
    "last, shape", [(("Transpose", "sum"), ("D", "Q")), (("Identity", "mean"), ("D", 1))]
)
def test_a_network_with_values_of_another_shape_is_an_error_when_it_runs(tmp_path, last, shape):
    path = write_network(tmp_path / "own.onnx", last, shape=shape)
    network = load_network(path, device="cpu")
    said = refusal(DeviceError, reconstruct, ball(), network)
    assert said.startswith("the network failed on cpu: ")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_values_that_are_not_finite_are_refused(value):
    def network(patches, table, voxels, offsets):
        return np.full((len(voxels), len(offsets)), value, np.float32)

    assert refusal(ModelError, reconstruct, ball(), network, 2) == (
        "the network gave values that are NaN, infinite or beyond 1e15: it cannot be used for this "
        "grid; use another model="
    )


@pytest.mark.parametrize("kind", ["folder", "FIFO", "empty", "half", "absent"])
def test_a_path_that_is_no_model_file_is_an_error_of_one_line(folder, command, kind):
    whole = shipped_models()["fast"].read_bytes()
    os.mkdir("folder.onnx")
    os.mkfifo("FIFO.onnx")
    Path("empty.onnx").write_bytes(b"")
    Path("half.onnx").write_bytes(whole[: len(whole) // 2])
    np.save("in.npy", ball().values)
    code, out, err = command("upsample", "in.npy", "out.ply", "--model", f"{kind}.onnx")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert err.startswith("Error: ") and f"{kind}.onnx" in err and not os.path.exists("out.ply")


@pytest.mark.parametrize("flipped", [(0, 1), (1, 2)], ids=["about z", "about x"])
def test_a_mean_maps_a_field_after_a_half_turn_to_the_turned_surface(flipped):
    """The plain network does so only approximately; otherwise the mean would have no effect."""
    field, nodes = rescale(ball(16, 5.0)), tuple(axis + 3 for axis in flipped)
    plain, apart = load_network("fast"), []

    def dense_values(network, field):
        """Return the values at the nodes of every voxel of the band, NaN elsewhere."""
        values = network(*network_inputs(field), block_offsets(2))
        dense = np.full((*field.shape, 3, 3, 3), np.nan, np.float32)
        dense[is_active(field)] = values.reshape(-1, 3, 3, 3)
        return dense

    for network in (plain, replace(plain, symmetries=4)):
        turned = dense_values(network, np.ascontiguousarray(np.flip(field, flipped)))
        off = np.abs(np.flip(turned, flipped + nodes) - dense_values(network, field))
        apart.append(np.nanmax(off))
    assert apart[1] < 1e-5 < 1e-3 < apart[0]
    assert load_network("best").symmetries == 4
