"""The self-test: what it says, and when it fails."""

import json
import re

import numpy as np
import pytest

from super_sdf.cli import selftest
from super_sdf import errors as extras
from super_sdf.errors import EXTRAS
from super_sdf.network import network
from super_sdf.cli.selftest import Finding, run_checks

pytestmark = pytest.mark.usefixtures("cpu_build")


NETWORKS = ("base", "fast", "mask", "noisy")


def find(findings, what):
    """Return the finding on something."""
    return next(finding for finding in findings if finding.what == what)


@pytest.fixture
def only_fast(monkeypatch):
    """One network instead of all that are shipped."""
    monkeypatch.setattr(selftest, "shipped_models", lambda: {"fast": SHIPPED["fast"]})


@pytest.fixture
def gpu(monkeypatch, only_fast):
    """A GPU as far as the self-test sees: its values are the CPU's, and something besides."""
    besides = {"voxels": 0.0}
    run_network = selftest.run_network

    def shifted(name, device, ball):
        values, microseconds = run_network(name, "cpu", ball)
        return values + besides["voxels"] * (device == "cuda"), microseconds

    monkeypatch.setattr(selftest, "check_cuda", lambda: None)
    monkeypatch.setattr(selftest, "describe_gpu", lambda: "NVIDIA H100, driver 580.1, 83.9 GB free")
    monkeypatch.setattr(selftest, "run_network", shifted)
    return besides


def test_everything_is_checked_on_the_cpu():
    findings = list(run_checks("cpu"))
    networks = [f"{name}{kind}" for kind in ("", "-int8") for name in NETWORKS]
    assert [finding.what for finding in findings] == [
        *("versions", "memory"),
        *(f"network {name} on cpu" for name in networks),
        *(f"extra {name}" for name in EXTRAS),
    ]
    assert all(finding.state != "failed" for finding in findings)
    said = find(findings, "network base on cpu").says
    assert re.fullmatch(r"off by 0\.0\d\d voxels at most on a ball, [\d.]+ us per voxel", said)
    assert re.fullmatch(r"[\d.]+ GB free", find(findings, "memory").says)


def test_cuda_that_is_missing_fails_only_where_it_should_be(monkeypatch, only_fast):
    assert find(run_checks("auto"), "cuda").state == "missing"
    found = find(run_checks("cuda"), "cuda")
    assert found.state == "failed" and "install onnxruntime-gpu in place of" in found.says
    monkeypatch.setattr(selftest, "available_devices", lambda: ["cpu", "cuda"])
    assert find(run_checks("auto"), "cuda").state == "failed"


def test_cuda_is_compared_with_the_cpu(gpu):
    findings = list(run_checks())
    assert find(findings, "cuda").says == "NVIDIA H100, driver 580.1, 83.9 GB free"
    found = find(findings, "network fast on cuda")
    assert found.state == "ok" and found.says.endswith(
        " us per voxel, 0e+00 voxels from the values of the CPU"
    )
    gpu["voxels"] = 2e-4
    found = find(run_checks(), "network fast on cuda")
    assert found.state == "failed" and found.figures["from_cpu_voxels"] == pytest.approx(2e-4, 0.1)
    assert found.says.endswith(
        "2e-04 voxels from the values of the CPU; "
        "allowed are 0.05 on the ball and 1e-04 from the CPU"
    )


@pytest.mark.parametrize("wrong", [0.1, np.nan])
def test_wrong_values_fail(monkeypatch, wrong, only_fast):
    run = selftest.run_network
    monkeypatch.setattr(selftest, "run_network", lambda *inputs: (run(*inputs)[0] + wrong, 1.0))
    assert find(run_checks("cpu"), "network fast on cpu").state == "failed"


def test_both_kinds_of_onnxruntime_at_once_fail_and_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr(selftest, "is_installed", lambda package: True)
    found = selftest.check_versions()
    assert found.state == "failed" and found.says.endswith(
        "; onnxruntime and onnxruntime-gpu are both installed: uninstall both, then install one"
    )
    monkeypatch.setattr(extras, "find_spec", lambda module: None)
    assert selftest.check_extra("3mf", EXTRAS["3mf"]) == Finding(
        "missing", "extra 3mf", "no lxml, networkx: pip install -e '.[3mf]' in a clone of super-sdf"
    )


def test_the_command_prints_a_line_a_check_and_its_exit_code_tells(command, only_fast):
    code, out, err = command("info", "--check")
    lines = out.splitlines()
    assert (code, err) == (0, "") and lines[-1] == "What is installed works."
    assert lines[0].startswith("ok       versions: super-sdf ")
    assert all(re.match(r"(ok      |missing ) \w+", line) for line in lines[:-1])
    code, out, _ = command("info", "--check", "--device", "cuda", "--json")
    report = json.loads(out)
    assert code == 1 and report["works"] is False
    found = next(f for f in report["findings"] if f["what"] == "network fast on cpu")
    assert found["state"] == "ok" and found["figures"]["off_voxels"] < 0.05


SHIPPED = network.shipped_models()
MISSING = "super-sdf was installed without its networks: install it again"


@pytest.fixture
def models(tmp_path, monkeypatch):
    """A folder of networks that replaces the shipped ones; without it the package has none."""
    folder = tmp_path / "models"
    monkeypatch.setattr(network, "MODELS", folder)
    return folder


def test_a_package_without_networks_or_that_for_masks_says_so(models, command, tmp_path):
    code, out, err = command("info")
    assert (code, out.splitlines()[-1], err) == (1, f"models: {MISSING}", "")
    code, out, err = command("info", "--json")
    facts = json.loads(out)
    assert (code, facts["fault"], facts["models"], err) == (1, MISSING, {}, "")
    code, out, err = command("info", "--check", "--device", "cpu")
    assert (code, err) == (1, "") and f"failed   networks: {MISSING}\n" in out
    words = ("upsample", tmp_path / "in.npy", tmp_path / "out.ply")
    assert command(*words) == (1, "", f"Error: the network 'base' is missing: {MISSING}\n")
    models.mkdir()
    (models / "fast.onnx").write_bytes(SHIPPED["fast"].read_bytes())
    network._load_once.cache_clear()
    np.save(tmp_path / "in.npy", np.linalg.norm(np.indices((9, 9, 9)) - 4, axis=0) < 3)
    code, _, err = command(*words, "--quality", "fast")
    want = f"Error: the network 'mask' is missing: {MISSING}"
    assert (code, err.splitlines()[-1]) == (1, want)


def test_a_network_file_that_cannot_be_read_is_a_line_and_the_others_are_shown(models, command):
    models.mkdir()
    (models / "fast.onnx").write_bytes(SHIPPED["fast"].read_bytes())
    (models / "base.onnx").write_bytes(b"text")
    fault = f"{models / 'base.onnx'} is no ONNX file that onnxruntime can run: "
    code, out, err = command("info")
    assert (code, err) == (1, "") and f"model base\n  fault: {fault}" in out
    assert "model fast\n  accuracy: " in out
    code, out, err = command("info", "--check", "--device", "cpu")
    assert (code, err) == (1, "") and f"\nfailed   network base on cpu: {fault}" in out
    assert f"\n1 of {2 + 2 + len(EXTRAS)} checks failed\n" in out
