"""CUDA, tested without a GPU: errors that name what is missing, no silent fallback.

Fakes stand in for the GPU; `super-sdf info --check --device cuda` tests a real one.
"""

import ctypes
from types import SimpleNamespace

import numpy as np
import pytest

from super_sdf import load_network
from super_sdf.errors import DeviceError, ModelError
from super_sdf.network import network, onnx
from super_sdf.network.contract import INPUTS, TRIAL
from super_sdf.network.onnx import CHUNK_INPUT, CPU, CUDA, CUDA_CHUNK, CUDA_OPTIONS, VERSION, ort

pytestmark = pytest.mark.usefixtures("cpu_build")
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


class FakeSession:
    """A session on CUDA that fulfils the contract, and its own binding."""

    def __init__(self):
        self.fails, self.runs = "", []
        self.get_providers = lambda: [CUDA, CPU]
        self.get_inputs = lambda: [SimpleNamespace(name=n, type=t) for n, t in INPUTS.items()]
        self.get_outputs = lambda: [SimpleNamespace(name="values", type="tensor(float)")]
        self.get_overridable_initializers = lambda: [SimpleNamespace(name=CHUNK_INPUT)]
        metadata = SimpleNamespace(custom_metadata_map={"format_version": "1"})
        self.get_modelmeta = lambda: metadata

    def io_binding(self):
        self.runs.append({})
        return self

    def bind_ortvalue_input(self, name, value):
        assert name not in self.runs[-1]
        self.runs[-1][name] = value

    def bind_output(self, name, place, number):
        self.runs[-1][name] = place

    def copy_outputs_to_cpu(self):
        return [np.ones((2, 2), np.float32)]

    def run_with_iobinding(self, binding, options):
        self.options = options
        if self.fails:
            raise RuntimeError(self.fails)


@pytest.fixture
def cuda_session(monkeypatch):
    """The session that onnxruntime opens on CUDA 13; on the CPU it opens real ones."""
    fake, real = FakeSession(), ort.InferenceSession

    def opened(path, options, providers, **more):
        if providers == [CPU]:
            return real(path, options, providers=providers)
        assert providers == [(CUDA, CUDA_OPTIONS), CPU] and more == {"enable_fallback": 0}
        fake.path = path
        return fake

    def uploaded(array, place, number):
        return SimpleNamespace(place=place, array=array)

    monkeypatch.setattr(ort, "get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr(ctypes, "CDLL", no_library(None))
    monkeypatch.setattr(ort, "InferenceSession", opened)
    monkeypatch.setattr(ort, "OrtValue", SimpleNamespace(ortvalue_from_numpy=uploaded))
    return fake


@pytest.mark.parametrize("requested", ["auto", "cuda"])
def test_cuda_that_works_is_used_with_each_input_copied_once(cuda_session, requested):
    loaded = load_network(device=requested)
    assert (loaded.device, loaded.precision, loaded.notes) == ("cuda", "float32", ())
    assert cuda_session.path == str(network.shipped_models()["base"])
    assert len(cuda_session.runs) == 1  # the trial run
    loaded(*TRIAL.values())
    places = cuda_session.runs[1]
    chunk = places.pop(CHUNK_INPUT)
    assert (chunk.place, chunk.array, places.pop("values")) == ("cpu", [CUDA_CHUNK], "cuda")
    assert {name: value.place for name, value in places.items()} == dict.fromkeys(INPUTS, "cuda")
    shrinks = cuda_session.options.get_run_config_entry("memory.enable_memory_arena_shrinkage")
    assert shrinks == "gpu:0"


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
    with pytest.raises(DeviceError) as caught:
        onnx.check_cuda()
    assert str(caught.value) == reason


def test_a_provider_that_falls_back_or_fails_is_an_error(cuda_session, monkeypatch):
    loaded = load_network(device="cuda")
    cuda_session.fails = "/a.cc:1 T f() [with T = int] CUDA failure 2: out of memory ; GPU=0 ; x"
    failed = "the network failed on cuda: CUDA failure 2: out of memory"
    with pytest.raises(DeviceError, match=f"^{failed}$"):
        loaded(*TRIAL.values())
    with pytest.raises(DeviceError, match=f"^{ASKED}{failed}; or use device='cpu'$"):
        load_network(device="cuda")
    monkeypatch.setattr(cuda_session, "get_providers", lambda: [CPU])
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
