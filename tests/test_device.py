"""CUDA, tested without a GPU: errors that name what is missing, no silent fallback.

Fakes stand in for the GPU; `super-sdf info --check --device cuda` tests a real one.
"""

import ctypes
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from super_sdf import load_network
from super_sdf.errors import DeviceError, ModelError
from super_sdf.network import network, onnx
from super_sdf.network.contract import INPUTS, TRIAL
from super_sdf.network.onnx import CHUNK_INPUT, CPU, CUDA, CUDA_OPTIONS, VERSION, ort

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
    with pytest.raises(DeviceError) as caught:
        onnx.check_cuda()
    assert str(caught.value) == reason


def test_a_provider_that_falls_back_or_fails_is_an_error(cuda_session):
    loaded = load_network(device="cuda")
    said = "/a.cc:1 T f() [with T = int] CUDA failure 2: out of memory ; GPU=0 ; x"
    cuda_session.run_with_iobinding.side_effect = RuntimeError(said)
    failed = "the network failed on cuda: CUDA failure 2: out of memory"
    with pytest.raises(DeviceError, match=f"^{failed}$"):
        loaded(*TRIAL.values())
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
