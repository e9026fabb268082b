"""The check of an installation: what it says, and when it fails."""

import json

import numpy as np
import pytest

from super_sdf import errors
from super_sdf.cli import info
from super_sdf.errors import EXTRAS
from super_sdf.network import network

pytestmark = pytest.mark.usefixtures("cpu_build")
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
