"""CUDA, tested without a GPU: bindings, errors that name what is missing, no silent fallback.

Fakes stand in for the GPU; `python -m lab cuda` and `super-sdf info --check --device cuda`
test a real one.
"""

import ctypes
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from super_sdf import load_network
from super_sdf.errors import DeviceError, ModelError
from super_sdf.network import device
from super_sdf.network.contract import INPUTS
from super_sdf.network.device import CPU, CUDA, CUDA_OPTIONS
from super_sdf.network.network import one_voxel, shipped_models
from super_sdf.network.onnx import CHUNK_INPUT, CUDA_CHUNK, ort

pytestmark = pytest.mark.usefixtures("cpu_build")
ASKED = "cuda was asked for, but "
HERE = f"onnxruntime {ort.__version__}"


def no_library(missing):
    """Return a library loader that finds every library except one."""

    def load(name, *arguments):
        if missing and (name == missing or str(name).endswith("providers_cuda.so")):
            raise OSError(f"{missing}: cannot open shared object file: No such file or directory")

    return load


@pytest.fixture
def cuda_build(cpu_build, monkeypatch):
    """An onnxruntime built for CUDA 13, with a driver and all libraries."""
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr(ort, "cuda_version", "13.0", raising=False)
    monkeypatch.setattr(ctypes, "CDLL", no_library(None))


class FakeBinding:
    """A binding that records what is bound to which device."""

    def __init__(self):
        self.inputs, self.outputs, self.copies = {}, {}, 0

    def bind_ortvalue_input(self, name, value):
        assert name not in self.inputs
        self.inputs[name] = value

    def bind_output(self, name, place, number):
        self.outputs[name] = (place, number)

    def copy_outputs_to_cpu(self):
        self.copies += 1
        return [np.ones((1, 1), np.float32)]


class FakeSession:
    """A session on CUDA that fulfils the contract."""

    def __init__(self):
        self.bindings, self.fails = [], ""
        self.get_providers = lambda: [CUDA, CPU]
        self.get_inputs = lambda: [SimpleNamespace(name=n, type=t) for n, t in INPUTS.items()]
        self.get_outputs = lambda: [SimpleNamespace(name="values", type="tensor(float)")]
        self.get_overridable_initializers = lambda: [SimpleNamespace(name=CHUNK_INPUT)]
        metadata = SimpleNamespace(custom_metadata_map={"format_version": "1"})
        self.get_modelmeta = lambda: metadata

    def io_binding(self):
        self.bindings.append(FakeBinding())
        return self.bindings[-1]

    def run_with_iobinding(self, binding, options):
        self.options = options
        if self.fails:
            raise RuntimeError(self.fails)


@pytest.fixture
def cuda_session(cuda_build, monkeypatch):
    """The session that onnxruntime opens on CUDA; on the CPU it opens real ones."""
    fake, real = FakeSession(), ort.InferenceSession

    def opened(path, options, providers, **more):
        if providers == [CPU]:
            return real(path, options, providers=providers)
        assert providers == [(CUDA, CUDA_OPTIONS), CPU] and more == {"enable_fallback": 0}
        fake.path = path
        return fake

    def uploaded(array, place, number):
        assert number == 0
        return SimpleNamespace(place=place, array=array)

    monkeypatch.setattr(ort, "InferenceSession", opened)
    monkeypatch.setattr(ort.OrtValue, "ortvalue_from_numpy", uploaded)
    return fake


@pytest.mark.parametrize("requested", ["auto", "cuda"])
def test_cuda_that_works_is_used(cuda_session, requested):
    network = load_network(device=requested)
    assert (network.device, network.precision, network.notes) == ("cuda", "float32", ())
    assert cuda_session.path == str(shipped_models()["base"])
    assert len(cuda_session.bindings) == 1  # the trial run
    network(*one_voxel().values())
    binding = cuda_session.bindings[1]
    chunk = binding.inputs.pop(CHUNK_INPUT)
    assert (chunk.place, chunk.array) == ("cpu", [CUDA_CHUNK])
    places = {name: value.place for name, value in binding.inputs.items()}
    assert places == dict.fromkeys(INPUTS, "cuda")
    assert binding.outputs == {"values": ("cuda", 0)} and binding.copies == 1  # nothing more
    shrinks = cuda_session.options.get_run_config_entry("memory.enable_memory_arena_shrinkage")
    assert shrinks == "gpu:0"


NO_PROVIDER = f"{HERE} here has no CUDA provider: install onnxruntime-gpu in place of onnxruntime"


@pytest.mark.parametrize(
    ("missing", "reason"),
    [
        ("the provider", NO_PROVIDER),
        ("libcuda.so.1", "there is no libcuda.so.1: install the NVIDIA driver"),
        (
            "libcublasLt.so.13",
            f"{HERE} for CUDA 13.0 does not find libcublasLt.so.13: pip install "
            "'onnxruntime-gpu[cuda,cudnn]' brings CUDA's libraries",
        ),
    ],
)
def test_what_is_missing_for_cuda_is_named(cuda_build, monkeypatch, missing, reason):
    if missing == "the provider":
        monkeypatch.setattr(ort, "get_available_providers", lambda: [CPU])
        monkeypatch.setattr(ort, "cuda_version", "")
    monkeypatch.setattr(ctypes, "CDLL", no_library(missing))
    with pytest.raises(DeviceError) as caught:
        load_network(device="cuda")
    assert str(caught.value) == f"{ASKED}{reason}; or use --device cpu"


def test_a_provider_that_falls_back_or_fails_is_an_error(cuda_session, monkeypatch):
    network = load_network(device="cuda")
    cuda_session.fails = "/a.cc:1 T f() [with T = int] CUDA failure 2: out of memory ; GPU=0 ; x"
    with pytest.raises(DeviceError, match=r"^the network failed on cuda: CUDA failure 2: out of"):
        network(*one_voxel().values())
    with pytest.raises(DeviceError) as caught:
        load_network(device="cuda")
    reason = "CUDA does not run here: CUDA failure 2: out of memory"
    assert str(caught.value) == f"{ASKED}{reason}; or use --device cpu"
    monkeypatch.setattr(cuda_session, "get_providers", lambda: [CPU])
    with pytest.raises(DeviceError, match="could not start its CUDA provider; or use --device"):
        load_network(device="cuda")


@pytest.mark.parametrize("gpu", [True, False])
def test_auto_falls_back_with_a_note_if_there_is_a_gpu(monkeypatch, gpu):
    monkeypatch.setattr(device, "has_gpu", lambda: gpu)
    network = load_network(device="auto")
    note = f"a GPU seems to be here, but the network runs on the CPU: {NO_PROVIDER}"
    assert (network.device, network.precision) == ("cpu", "int8")
    assert network.notes == (note,) * gpu


@pytest.mark.parametrize("requested", ["auto", "cpu", "cuda"])
def test_a_bad_file_is_not_reported_as_a_failure_of_cuda(tmp_path, monkeypatch, requested):
    (tmp_path / "bad.onnx").write_bytes(b"not a graph")
    with pytest.raises(ModelError, match=r"bad\.onnx is no ONNX file that onnxruntime can run"):
        load_network(tmp_path / "bad.onnx", device=requested)


@pytest.mark.parametrize("has_driver, has_file", [(False, False), (True, False), (False, True)])
def test_a_gpu_is_seen_by_its_driver_and_described(monkeypatch, tmp_path, has_driver, has_file):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert device.describe_gpu() is None
    fake = tmp_path / "nvidia-smi"
    fake.write_text("#!/bin/sh\necho 'NVIDIA H100, 580.1, 81559, 1559'\n")
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    assert device.describe_gpu() == "NVIDIA H100, driver 580.1, 83.9 GB free"
    monkeypatch.setattr(ctypes, "CDLL", no_library(None if has_driver else "libcuda.so.1"))
    monkeypatch.setattr(Path, "exists", lambda self: has_file and str(self) == "/dev/nvidia0")
    assert device.has_gpu() == (has_driver or has_file)


def test_shipped_files_let_the_chunk_be_chosen():
    for path in shipped_models().values():
        network = load_network(path, device="cpu")
        given = [given.name for given in network.session.get_overridable_initializers()]
        assert given == [CHUNK_INPUT, *["gate.threshold"] * ("gated" in network.card)]
