"""Networks: the contract of their files, their values, CUDA (by stand-ins), and ``info``."""

import ctypes
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from conftest import ball, refusal
from onnx import TensorProto
from onnx_files import write_network

from super_sdf import errors, load_network, reconstruct
from super_sdf.cli import info
from super_sdf.errors import EXTRAS, DeviceError, FileError, ModelError, OptionError
from super_sdf.network import network, onnx
from super_sdf.network.contract import INPUTS, trial
from super_sdf.network.network import KIND_MODELS, shipped_models
from super_sdf.network.onnx import CHUNK_INPUT, CPU, CUDA, CUDA_OPTIONS, VERSION, ort
from super_sdf.options import QUALITIES
from super_sdf.refine.band import gather_patches, is_active, neighbour_table, rescale
from super_sdf.refine.nodes import block_offsets

pytestmark = pytest.mark.usefixtures("cpu_build")


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
    "other inputs": ({"card": {"format_version": "1", "wide": "3"}}, OF_FORMAT + r"\(wide 3\)"),
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

    for each in (plain, replace(plain, symmetries=4)):
        turned = dense_values(each, np.ascontiguousarray(np.flip(field, flipped)))
        off = np.abs(np.flip(turned, flipped + nodes) - dense_values(each, field))
        apart.append(np.nanmax(off))
    assert apart[1] < 1e-5 < 1e-3 < apart[0]
    assert load_network("best").symmetries == 4


# CUDA without a GPU: errors that name what is missing, no silent fallback. ``super-sdf info --check
# --device cuda`` tests a real one.


ASKED = "cuda was asked for, but "
NO_PROVIDER = f"{VERSION} here has no CUDA provider: install onnxruntime-gpu in place of "
NO_PROVIDER += "onnxruntime"


def no_library(missing):
    """Return a library loader that finds every library except one."""

    def load(name, *arguments):
        if missing and (name == missing or str(name).endswith("providers_cuda.so")):
            raise OSError(f"{missing}: cannot open shared object file: No such file or directory")
        return True

    return load


def made_session():
    """Return what stands in for a session on CUDA that fulfils the contract."""
    inputs = [SimpleNamespace(name=name, type=kind) for name, kind in INPUTS.items()]
    session = MagicMock()
    session.get_providers.return_value = [CUDA, CPU]
    session.get_inputs.return_value = inputs
    session.get_outputs.return_value = [SimpleNamespace(name="values", type="tensor(float)")]
    session.get_overridable_initializers.return_value = [SimpleNamespace(name=CHUNK_INPUT)]
    session.get_modelmeta.return_value.custom_metadata_map = {"format_version": "1"}
    session.io_binding.return_value.copy_outputs_to_cpu.return_value = [np.ones((2, 2), np.float32)]
    return session


@pytest.fixture
def cuda_session(monkeypatch):
    """The session that onnxruntime opens on CUDA 13; on the CPU it opens real ones."""
    fake, real = made_session(), ort.InferenceSession

    def opened(path, options, providers, **more):
        if providers == [CPU]:
            return real(path, options, providers=providers)
        assert providers == [(CUDA, CUDA_OPTIONS), CPU] and more == {"enable_fallback": 0}
        fake.path = path
        return fake

    monkeypatch.setattr(ort, "get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr(ctypes, "CDLL", no_library(None))
    monkeypatch.setattr(ort, "InferenceSession", opened)
    monkeypatch.setattr(ort, "OrtValue", MagicMock())
    return fake


@pytest.mark.parametrize("requested", ["auto", "cuda"])
def test_cuda_that_works_is_used(cuda_session, requested):
    loaded = load_network(device=requested)
    assert (loaded.device, loaded.precision, loaded.notes) == ("cuda", "float32", ())
    assert cuda_session.path == str(network.shipped_models()["base"])
    assert cuda_session.run_with_iobinding.call_count == 1  # the trial run


@pytest.mark.parametrize(
    ("missing", "reason"),
    [
        ("the provider", NO_PROVIDER),
        ("libcuda.so.1", "there is no libcuda.so.1: install the NVIDIA driver"),
        (
            "libcublasLt.so.13",
            f"{VERSION} does not load, libcublasLt.so.13: cannot open shared object file: No such "
            "file or directory: pip install 'onnxruntime-gpu[cuda,cudnn]' brings CUDA's libraries",
        ),
    ],
)
def test_what_is_missing_for_cuda_is_named(cuda_session, monkeypatch, missing, reason):
    if missing == "the provider":
        monkeypatch.setattr(ort, "get_available_providers", lambda: [CPU])
    monkeypatch.setattr(ctypes, "CDLL", no_library(missing))
    assert refusal(DeviceError, onnx.check_cuda) == reason


def test_a_provider_that_falls_back_or_fails_is_an_error(cuda_session):
    loaded = load_network(device="cuda")
    said = "/a.cc:1 T f() [with T = int] CUDA failure 2: out of memory ; GPU=0 ; x"
    cuda_session.run_with_iobinding.side_effect = RuntimeError(said)
    failed = "the network failed on cuda: CUDA failure 2: out of memory"
    with pytest.raises(DeviceError, match=f"^{failed}$"):
        loaded(*trial().values())
    with pytest.raises(DeviceError, match=f"^{ASKED}{failed}; or use device='cpu'$"):
        load_network(device="cuda")
    cuda_session.get_providers.return_value = [CPU]
    with pytest.raises(DeviceError, match="could not start its CUDA provider; or use device"):
        load_network(device="cuda")


@pytest.mark.parametrize("gpu", [True, False])
def test_auto_falls_back_with_a_note_if_there_is_a_gpu(monkeypatch, gpu):
    monkeypatch.setattr(network, "has_driver", lambda: gpu)
    loaded = load_network(device="auto")
    note = f"a GPU seems to be here, but the network runs on the CPU: {NO_PROVIDER}"
    assert (loaded.device, loaded.precision) == ("cpu", "int8")
    assert loaded.notes == (note,) * gpu


@pytest.mark.parametrize("requested", ["auto", "cpu", "cuda"])
def test_a_bad_file_is_not_reported_as_a_failure_of_cuda(tmp_path, requested):
    (tmp_path / "bad.onnx").write_bytes(b"not a graph")
    with pytest.raises(ModelError, match=r"bad\.onnx is no ONNX file that onnxruntime can run"):
        load_network(tmp_path / "bad.onnx", device=requested)


# The check of an installation: what it says, and when it fails


SHIPPED = network.shipped_models()


@pytest.fixture
def models(tmp_path, monkeypatch):
    """A folder of networks that replaces the shipped ones, with "fast" in it."""
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / "fast.onnx").write_bytes(SHIPPED["fast"].read_bytes())
    monkeypatch.setattr(network, "MODELS", folder)
    return folder


def test_every_network_and_extra_is_checked(command):
    code, out, err = command("info", "--check", "--device", "cpu", "--json")
    report = json.loads(out)
    assert (code, err, report["works"]) == (0, "", True)
    whats = [finding["what"] for finding in report["findings"]]
    networks = [f"network {name} on cpu" for name in SHIPPED]
    assert whats == ["versions", "networks", *networks, *(f"extra {name}" for name in EXTRAS)]
    assert all("off by 0." in f["says"] for f in report["findings"] if f["what"] in networks)


def test_a_line_a_finding_and_the_exit_code_tells(command, models, monkeypatch):
    code, out, _ = command("info")
    assert code == 0 and "missing  cuda: " in out and "\nok       networks: fast\n" in out
    assert "network fast on cpu" not in out
    code, out, _ = command("info", "--device", "cuda")
    assert code == 1 and "failed   cuda: " in out and "install onnxruntime-gpu" in out
    monkeypatch.setattr(errors, "find_spec", lambda module: None)
    *lines, last = command("info")[1].splitlines()
    assert "missing  extra 3mf: lxml, networkx" in lines and len(lines) < 24  # on one screen
    assert last == f"missing  to install: pip install -e '.[{','.join(EXTRAS)}]' in a clone"


@pytest.mark.parametrize("wrong", [1.0, np.nan])
def test_wrong_values_fail(monkeypatch, wrong, models):
    run = network.Network.__call__
    monkeypatch.setattr(network.Network, "__call__", lambda *given, **more: run(*given) * 0 + wrong)
    assert info.check_network("fast", "cpu")[0] == "failed"


MISSING = "super-sdf was installed without its networks: install it again"


def test_a_package_without_networks_or_that_for_masks_says_so(models, command, tmp_path):
    np.save(tmp_path / "in.npy", np.linalg.norm(np.indices((9, 9, 9)) - 4, axis=0) < 3)
    words = ("upsample", tmp_path / "in.npy", tmp_path / "out.ply")
    network._load_once.cache_clear()
    code, _, err = command(*words, "--quality", "fast")
    assert code == 1 and err.endswith(f"Error: the network 'mask' is missing: {MISSING}\n")
    (models / "fast.onnx").unlink()
    code, out, err = command("info", "--device", "cpu")
    assert (code, err) == (1, "") and f"failed   networks: {MISSING}\n" in out
    assert command(*words) == (1, "", f"Error: the network 'base' is missing: {MISSING}\n")
