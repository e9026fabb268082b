"""What depends on the processor: which network ``auto`` takes, its fingerprint, and old ones."""

import hashlib
import os
import platform

import numpy as np
import pytest

from super_sdf import load_network
from super_sdf.cli.entry import main
from super_sdf.machine import processor
from super_sdf.network.network import Network, find_model, fingerprint_of, small_ball

CORE_2 = "fpu sse sse2 pni ssse3 cx16"
NEHALEM = f"{CORE_2} sse4_1 sse4_2 popcnt"
SANDY_BRIDGE = f"{NEHALEM} avx"
HASWELL = f"{SANDY_BRIDGE} avx2 fma"


@pytest.fixture
def describe(monkeypatch, tmp_path):
    """Let the system describe another processor."""

    def go(text):
        (tmp_path / "cpuinfo").write_text(text)
        monkeypatch.setattr(processor, "CPUINFO", str(tmp_path / "cpuinfo"))

    return go


def x86(flags, name="A (R) processor @ 2.60GHz"):
    """Return the description of a machine of two cores."""
    return f"processor\t: 0\nmodel name\t: {name}\nflags\t: {flags}\n\nflags\t: mmx\n"


ARM = "processor\t: 0\nFeatures\t: fp asimd\nCPU part\t: 0xd0c\n\n"
AUTO = {
    "AVX2": (x86(HASWELL), "base-int8"),
    "AVX without AVX2": (x86(SANDY_BRIDGE), "base"),
    "no AVX": (x86(NEHALEM), "base-int8"),
    "ARM": (ARM, "base-int8"),
    "nothing": ("", "base-int8"),
}


@pytest.mark.parametrize("kind", AUTO)
def test_auto_is_float32_where_int8_is_slower(describe, kind):
    text, want = AUTO[kind]
    describe(text)
    assert find_model("base")[0].stem == want
    assert find_model("base", "int8")[0].stem == "base-int8"
    assert find_model("base", "float32")[0].stem == "base"


def test_the_name_of_the_processor(describe, monkeypatch):
    describe(x86(HASWELL))
    assert processor.processor_name() == "A (R) processor @ 2.60GHz"
    monkeypatch.setattr(processor, "CPUINFO", "missing")
    assert processor.processor_name() == (platform.processor() or platform.machine())
    assert processor.lacking_instructions() == [] and not processor.lacks_avx2()


def test_a_processor_that_numpy_cannot_run_on_ends_in_a_line(describe, monkeypatch):
    monkeypatch.setattr(os, "_exit", lambda code: pytest.fail("the command was run"))
    describe(x86(CORE_2))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == (
        "Error: this processor has no SSE4.1, SSE4.2, POPCNT, and NumPy and onnxruntime need "
        "x86-64-v2: use another machine; a virtual one needs the host's processor (-cpu host)"
    )


@pytest.mark.parametrize("text", [x86(NEHALEM), ARM, ""])
def test_other_processors_go_on(describe, text):
    describe(text)
    processor.check_processor()


def test_the_small_ball_is_one():
    """The network gives its distances, and each voxel's neighbours have the patches beside it."""
    patches, table, voxels, offsets = small_ball()
    assert patches.shape == table.shape == (624, 27) and len(voxels) == 624
    there = table >= 0
    middle = patches[:, 13]
    np.testing.assert_array_equal(middle[table[there]], patches[there])
    assert (np.abs(patches[~there]) >= 3).all() and (np.abs(middle) < 3).all()
    values = load_network("fast")(patches, table, voxels, offsets)
    centre = np.flatnonzero((offsets == 0).all(1))
    np.testing.assert_allclose(values[:, centre[0]], middle, atol=0.1)


def test_the_fingerprint_is_that_of_the_chosen_network_and_of_nothing_else(monkeypatch):
    found = fingerprint_of("fast", "auto", "cpu")
    assert found == fingerprint_of("fast", "int8", "cpu")
    network = load_network("fast", device="cpu", threads=2)
    assert found.digest == hashlib.sha256(network(*small_ball()).tobytes()).hexdigest()
    assert found[1:] == ("cpu", processor.processor_name(), "int8")
    others = {
        fingerprint_of(*name, "cpu").digest for name in [("fast", "float32"), ("base", "auto")]
    }
    assert len(others | {found.digest}) == 3
    exact = Network.__call__
    monkeypatch.setattr(Network, "__call__", lambda *given: exact(*given) * np.float32(1 + 2**-20))
    assert fingerprint_of("fast", "auto", "cpu").digest != found.digest
