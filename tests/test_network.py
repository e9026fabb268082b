"""The contract of the ONNX file, the values of a network, and the errors of bad files."""

import os
import shutil
import warnings

import numpy as np
import pytest
from conftest import ball
from onnx_files import DOUBLE, FLOAT, metadata, write_network

from super_sdf import load_network, reconstruct, upsample
from super_sdf.errors import DeviceError, FileError, ModelError, OptionError
from super_sdf.network.decoder import check_output, to_blocks
from super_sdf.network.network import KIND_MODELS, Network, shipped_models
from super_sdf.network.onnx import CORE_CHUNK, CPU_CHUNK, cpu_chunk
from super_sdf.options import QUALITIES
from super_sdf.steps.band import find_band, gather_patches, neighbour_table, rescale
from super_sdf.steps.nodes import block_offsets


def network_inputs(grid):
    field = rescale(grid)
    voxels = find_band(field)
    rows = np.arange(len(voxels), dtype=np.int32)
    return gather_patches(field, voxels), neighbour_table(voxels, grid.shape), rows


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


def test_shipped_networks_are_small_and_fulfil_the_contract():
    names = {*(name for name, _ in QUALITIES.values()), *KIND_MODELS}
    assert {name.removesuffix("-int8") for name in shipped_models()} == names
    for name, path in shipped_models().items():
        assert path.stat().st_size < 20e6
        card = load_network(name, precision="float32").card
        assert card["name"] == name and card["receptive_field"] and card["parameters"]
        assert card["trained_on"] and card["trained_from_commit"] and card["accuracy"]


@pytest.mark.parametrize("factor", [4, 8])
def test_a_prediction_depends_neither_on_threads_nor_on_the_other_voxels_decoded(factor):
    """Bit for bit, so that a mesh does not depend on its slabs or on the number of threads."""
    patches, table, rows = network_inputs(ball())
    offsets = block_offsets(factor)
    one, two = (load_network("fast", threads=threads, precision="float32") for threads in (1, 2))
    values = one(patches, table, rows, offsets)
    for some in (rows[40:], rows[7:8]):
        np.testing.assert_array_equal(two(patches, table, some, offsets), values[some])


def test_shipped_networks_run_in_int8_on_the_cpu_and_other_files_as_they_are(tmp_path):
    given = *network_inputs(ball()), block_offsets(4)
    for quality in QUALITIES:
        whole, real = (load_network(quality, precision=p) for p in ("auto", "float32"))
        assert (whole.precision, whole.device, real.precision) == ("int8", "cpu", "float32")
        apart = np.abs(whole(*given) - real(*given)) / 2  # voxels
        assert 0 < apart.mean() < 3e-3 and apart.max() < 0.06
    own = shutil.copy(shipped_models()["base"], tmp_path / "own.onnx")
    shutil.copy(shipped_models()["base-int8"], tmp_path / "own-int8.onnx")
    assert load_network(own, device="cpu").precision == "float32"
    assert load_network(own, precision="int8").precision == "int8"


def test_int8_gives_the_same_bits_for_any_part_and_any_threads():
    """The other voxels in a call make no difference, so slabs make none either."""
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


def test_int8_without_an_int8_file_is_an_error(tmp_path):
    with pytest.raises(
        OptionError, match=r"none\.onnx has no int8 variant, .*none-int8\.onnx: write"
    ):
        load_network(tmp_path / "none.onnx", precision="int8")
    with pytest.raises(OptionError, match="precision is 'int4': give one of auto, float32, int8"):
        load_network(precision="int4")
    with pytest.raises(DeviceError, match="int8 is for the CPU: use --precision float32"):
        load_network(precision="int8", device="cuda")


def test_a_failing_run_is_a_device_error():
    patches, table, rows = network_inputs(ball())
    with pytest.raises(DeviceError, match="the network failed on cpu: "):
        load_network()(patches, table, rows + 10**6, block_offsets(2))


def test_names_files_and_devices_that_do_not_exist_are_refused(tmp_path):
    with pytest.raises(
        FileError, match="no model 'other': give an ONNX file or one of: fast, base, best"
    ):
        load_network("other")
    (tmp_path / "bad.onnx").write_bytes(b"not a graph")
    with pytest.raises(ModelError, match=r"bad\.onnx is no ONNX file that onnxruntime can run"):
        load_network(tmp_path / "bad.onnx")
    with pytest.raises(DeviceError, match="device is 'tpu': give one of auto, cpu, cuda"):
        load_network(device="tpu")


@pytest.fixture
def no_warnings():
    """Turn warnings into errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_any_file_that_fulfils_the_contract_runs(tmp_path):
    assert len(reconstruct(ball(), load_network(write_network(tmp_path / "own.onnx"))).faces)


# The last operators of a network, the declaration of its output, and the error.
TRANSPOSED = [("Transpose", ("sum",), "values", {})]
ONE_COLUMN = [("Identity", ("mean",), "values", {})]
WRONG = {
    "axes swapped": (TRANSPOSED, (FLOAT, "D", "Q"), " does not run with its own inputs: the "),
    "one value a voxel": (ONE_COLUMN, (FLOAT, "D", 1), " does not run with its own inputs: the "),
    "double": (
        [("Cast", ("sum",), "values", {"to": DOUBLE})],
        (DOUBLE, "D", "Q"),
        r" is no super-sdf network of format 1 \(format 1, .*outputs values tensor\(double\)\);",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_network_with_another_output_is_refused(tmp_path, name):
    last, output, message = WRONG[name]
    path = write_network(tmp_path / "own.onnx", last, output=output)
    with pytest.raises(ModelError, match=f"^{path}{message}") as caught:
        load_network(path, device="cpu")
    assert "\n" not in str(caught.value)


INFINITE = [("Sub", ("sum", "sum"), "zero", {}), ("Div", ("sum", "zero"), "values", {})]
NAN = [
    ("Abs", ("sum",), "above", {}),
    ("Neg", ("above",), "below", {}),
    ("Log", ("below",), "values", {}),
]


@pytest.mark.parametrize("last", [INFINITE, NAN], ids=["infinite", "NaN"])
@pytest.mark.parametrize("symmetries", [1, 2])
def test_values_that_are_not_finite_are_refused_with_their_count(
    tmp_path, no_warnings, last, symmetries
):
    loaded = load_network(write_network(tmp_path / "own.onnx", last), device="cpu")
    network = Network(loaded.session, loaded.card, "cpu", symmetries)
    for work in (upsample, reconstruct):
        with pytest.raises(ModelError) as caught:
            work(ball(), network, 2)
        bad, rest = str(caught.value).split(" values that the network gave are ")
        count, _, whole = bad.replace(",", "").split(" ", 2)
        assert int(count) == int(whole.split()[-1]) > 0
        assert rest == (
            "NaN, infinite or beyond 1e15: it cannot be used for this grid; use another --model"
        )


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e16])
def test_one_bad_value_among_many_is_found(no_warnings, value):
    values = np.zeros((5000, 125), np.float32)
    assert not to_blocks(values).any()
    values[4800, 7] = value
    with pytest.raises(ModelError, match=r"^1 of the 625,000 values that the network gave are NaN"):
        to_blocks(values)
    values[:2] = value
    with pytest.raises(ModelError, match=r"^251 of the 625,000 values"):
        to_blocks(values)


@pytest.mark.parametrize(
    ("given", "what"),
    [
        (np.zeros((3, 4), np.float32), r"float32 of shape \(3, 4\)"),
        (np.zeros((4, 3), np.int64), r"int64 of shape \(4, 3\)"),
        ([[1.0] * 3] * 4, r"list of shape \(4, 3\)"),
        (None, r"NoneType of shape \(\)"),
    ],
)
def test_the_values_of_a_function_as_network_are_checked_too(given, what):
    wanted = r" instead of float32 of shape \(4, 3\), \(voxels, offsets\)$"
    with pytest.raises(ModelError, match=f"^the network gave {what}{wanted}"):
        check_output(given, (4, 3))


DEEP, LONG = "[" * 100_000, "7" * 5000
CARDS = {
    "negative field": ({"receptive_field": "-5"}, "its receptive field is -5; it must be a whole"),
    "huge field": ({"receptive_field": "9" * 400}, "its receptive field is 9999999999"),
    "broken field": ({"receptive_field": "6.5"}, "its receptive field is 6.5; it must be a whole"),
    "truth": ({"receptive_field": "true"}, "its receptive field is True; it must be a whole"),
    "no width": ({"channels": "0"}, "its width is 0; it must be a whole number of channels from 1"),
    "digits": ({"receptive_field": LONG}, "its metadata 'receptive_field' cannot be read, '7777"),
    "deep": ({"data": DEEP}, r"its metadata 'data' cannot be read, '\[\[\[\[\[\["),
    "no version": (None, r"is no super-sdf network of format 1 \(format none, inputs patches ten"),
    "version": (
        {"format_version": "1\n" * 900},
        r"is no super-sdf network of format 1 \(format 1 1",
    ),
}


@pytest.mark.parametrize("name", CARDS)
def test_invalid_metadata_is_an_error_of_one_line(tmp_path, name):
    changed, message = CARDS[name]
    path = tmp_path / "own.onnx"
    if changed is None:
        write_network(path, card={})
    else:
        path.write_bytes(shipped_models()["fast"].read_bytes() + metadata(changed))
    with pytest.raises(ModelError, match=message) as caught:
        load_network(path, device="cpu")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400 + len(str(path))


def test_a_card_need_not_have_the_receptive_field(tmp_path):
    card = {"format_version": "1", "note": "not JSON"}
    network = load_network(write_network(tmp_path / "own.onnx", card=card), device="cpu")
    assert network.receptive_field is None and network.card["note"] == "not JSON"


def test_a_wider_network_takes_more_memory(tmp_path):
    shipped, path = shipped_models()["fast"], tmp_path / "wide.onnx"
    path.write_bytes(shipped.read_bytes() + metadata({"channels": "128"}))
    usual, wide = load_network(shipped, device="cpu"), load_network(path, device="cpu")
    assert usual.memory_bytes == (680, 8) and wide.memory_bytes == (1144, 8)
    assert wide.averaged(4).memory_bytes == (1744, 12)


@pytest.mark.parametrize(
    "kind", ["folder", "FIFO", "empty", "half", "text", "absent", "long", "NUL"]
)
def test_a_path_that_is_no_model_file_is_an_error_of_one_line(tmp_path, command, kind):
    path = tmp_path / "own.onnx"
    if kind == "folder":
        path.mkdir()
    elif kind == "FIFO":
        os.mkfifo(path)
    elif kind in ("empty", "half", "text"):
        whole = shipped_models()["fast"].read_bytes()
        path.write_bytes({"empty": b"", "half": whole[: len(whole) // 2], "text": b"me\n"}[kind])
    elif kind in ("long", "NUL"):
        path = {"long": "n" * 300 + ".onnx", "NUL": "a\0b.onnx"}[kind]
    np.save(tmp_path / "in.npy", ball().values)
    words = tmp_path / "in.npy", tmp_path / "out.ply", "--model", path, "--spacing", "1"
    code, out, err = command("upsample", *words, "--device", "cpu")
    assert (code, out, err.count("\n")) == (1, "", 1) and err.startswith("Error: ")
    assert "own.onnx" in err or kind in ("long", "NUL")
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize("voxels", [1, 511, 512, 1023, 1024, 50_000])
@pytest.mark.parametrize("threads", [1, 2, 64])
def test_chunks_on_the_cpu_are_equal_and_leave_a_row_free(voxels, threads):
    rows = cpu_chunk(voxels, threads)
    chunks = -(-(voxels + 1) // rows)
    assert rows <= min(CORE_CHUNK * threads, CPU_CHUNK)
    assert chunks * rows - (voxels + 1) < chunks  # less than a row of each is padding
